"""The ensemble of Figure 1(a): K actors on one shared trunk, K critics on another, trained by DDPG.

Letters in the shape comments:
    K heads    B transitions    E rows for each head    I inputs
    O observation    G goal    A action    H = 256 units of a hidden layer

A mini-batch comes in with a weight for each transition, the variance of the Q-values goes out; the
prioritisation is in vcp.py.
"""

import copy
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch

HIDDEN = 256  # Appendix B
PART = 256  # rows that are scored in one call: what a cache holds, whatever the number of threads


def linear(x: torch.Tensor, w: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """w·x + b for one layer, w (J, I) and b (J,), or for a stack of K, w (K, J, I) and b (K, J).
    x is (..., I) for one layer, (B, I) or (K, B, I) for a stack, which gives (K, B, J)."""
    if w.ndim == 2:
        return torch.nn.functional.linear(x, w, b)
    return torch.baddbmm(b[:, None], x.expand(len(w), -1, -1), w.mT)


class MultiHeadMLP:
    """Figure 1(a) and Appendix B: a trunk of two layers that all heads share, then, for each head,
    one more layer of 256 units and an output.

    `net(k, x)` is head k's network, the one to train, with an optimiser over `net.parameters()`;
    `net.all_heads(x)` is all of them in one call, without gradients.

    Each hidden layer is followed by a ReLU, as in HER's code, where Appendix B takes the networks
    from (the released code has none where the trunk ends: NOTES.md, "the end of the trunk").
    squash: applied to the output; torch.tanh for the actor, None for the critic.
    """

    def __init__(self, inputs, outputs, num_heads, generator, device="cpu", squash=None):
        def xavier(*shape):  # U(-√(6/(I+J)), √(6/(I+J)))
            bound = (6 / (shape[-1] + shape[-2])) ** 0.5
            return torch.empty(shape).uniform_(-bound, bound, generator=generator).to(device)

        def zeros(*shape):
            return torch.zeros(shape, device=device)

        self.squash = squash or (lambda x: x)
        self.trunk = [xavier(HIDDEN, inputs), zeros(HIDDEN), xavier(HIDDEN, HIDDEN), zeros(HIDDEN)]
        self.stacks = [xavier(num_heads, HIDDEN, HIDDEN), zeros(num_heads, HIDDEN)]  # (K, ...)
        self.stacks += [xavier(num_heads, outputs, HIDDEN), zeros(num_heads, outputs)]
        # Head k's own four tensors: views into the stacks, so training it changes its slice alone.
        self.own = [[p[k] for p in self.stacks] for k in range(num_heads)]

    def parameters(self) -> list[torch.Tensor]:
        """The trunk's four tensors, then four of each head."""
        return [*self.trunk, *(p for own in self.own for p in own)]

    def __call__(self, k: int | slice, x: torch.Tensor, frozen: bool = False) -> torch.Tensor:
        """Head k's network, (B, I) -> (B, J), or those of some heads, each for rows of its own,
        (n, B, I) -> (n, B, J). frozen: without gradients for their parameters."""
        own = self.own[k]
        if isinstance(k, slice):  # not self.stacks[k]: the gradients are those of the views
            own = [torch.stack(p) for p in zip(*own, strict=True)]
        params = [*self.trunk, *own]
        return self._forward([p.detach() for p in params] if frozen else params, x)

    @torch.no_grad()
    def all_heads(self, x: torch.Tensor, heads: slice = slice(None)) -> torch.Tensor:
        """n chosen heads in one call. x is (n, E, I), rows of their own for each head, or (B, I),
        the same rows for all; returns (n, E, J) or (n, B, J)."""
        return self._forward([*self.trunk, *(p[heads] for p in self.stacks)], x)

    def _forward(self, params: list[torch.Tensor], x: torch.Tensor) -> torch.Tensor:
        w1, b1, w2, b2, w3, b3, w4, b4 = params
        h = linear(x, w1, b1).relu_()  # in place: a fresh array would cost as much as the ReLU
        h = linear(h, w2, b2).relu_()  # the embedding of Figure 1(a)
        h = linear(h, w3, b3).relu_()
        return self.squash(linear(h, w4, b4))


class Normalizer:
    """Running mean and standard deviation of [observation | goal], not in the paper but in HER's
    code: clip to ±200, standardise (std at least 0.01), clip to ±5."""

    def __init__(self, dim: int, device="cpu"):
        self.count = 0
        self.sums = torch.zeros(2, dim, dtype=torch.float64)  # of x and x², of millions of rows
        self.mean = torch.zeros(dim, device=device)
        self.std = torch.ones(dim, device=device)

    def update(self, x: np.ndarray) -> None:
        """Add the rows of x, (B, dim), to the statistics."""
        x = np.clip(np.asarray(x, dtype=np.float64), -200, 200)
        if not len(x):
            return
        self.count += len(x)
        self.sums += torch.from_numpy(np.stack([x.sum(axis=0), np.square(x).sum(axis=0)]))
        mean, mean_of_squares = self.sums / self.count
        self.mean.copy_(mean)
        self.std.copy_((mean_of_squares - mean**2).clamp(min=0.01**2).sqrt())

    def state_dict(self) -> dict:
        return {"count": self.count, "sums": self.sums, "mean": self.mean, "std": self.std}

    def load_state_dict(self, state: dict) -> None:
        self.count = state["count"]
        for name in ("sums", "mean", "std"):
            getattr(self, name).copy_(state[name])

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        return ((x.clamp(-200, 200) - self.mean) / self.std).clamp(-5, 5)


class EnsembleDDPG:
    """DDPG with K heads, Section 4.1: head k has its own actor, critic, target actor and target
    critic, and is trained on mini-batches of its own (Algorithm 2, lines 14-17).

    Observations, goals, actions and values are NumPy arrays; actions are in [-1, 1].
    gamma: discount (the paper does not say; 1 - 1/T for episodes of T steps).
    polyak: share of the old target kept in `update_targets` (Appendix B: 0.95).
    action_penalty: weight of mean(μ²) in the actor's loss (not in the paper; 1 in HER's code).
    """

    def __init__(
        self,
        obs_dim: int,
        goal_dim: int,
        action_dim: int,
        *,
        gamma: float,
        num_heads: int = 16,
        learning_rate: float = 1e-3,
        polyak: float = 0.95,
        action_penalty: float = 1.0,
        device: str = "cpu",
        seed: int = 0,
    ):
        self.num_heads, self.gamma, self.polyak = num_heads, gamma, polyak
        self.action_penalty = action_penalty
        self.device = torch.device(device)
        generator = torch.Generator().manual_seed(seed)
        state_dim = obs_dim + goal_dim

        common = (num_heads, generator, device)
        actor = partial(MultiHeadMLP, state_dim, action_dim, *common, squash=torch.tanh)
        critic = partial(MultiHeadMLP, state_dim + action_dim, 1, *common)
        self.actor, self.critic = actor(), critic()
        self.target_actor, self.target_critic = actor(), critic()
        self._move_targets(trunk_step=1.0, head_step=1.0)  # targets start as copies
        self._networks = [self.actor, self.critic, self.target_actor, self.target_critic]
        self._critic_snapshot = copy.deepcopy(self.critic)  # before gradients are asked for
        self.normalizer = Normalizer(state_dim, device)

        # One Adam for everything; it passes over heads without a gradient, those not updated. With
        # one for each head, as in the released code, the trunks die (NOTES.md, "the trunks' Adam").
        params = [p.requires_grad_() for net in (self.actor, self.critic) for p in net.parameters()]
        self.optimizer = torch.optim.Adam(params, learning_rate, fused=True)

    @torch.no_grad()
    def act(self, obs: np.ndarray, goal: np.ndarray, heads: slice = slice(None)) -> np.ndarray:
        """Algorithm 2, line 7, without noise: a = μ_k(s, g) for all heads in one call.
        obs (n, E, O) and goal (n, E, G) -> (n, E, A), for the n heads that `heads` picks or all K.
        ValueError for rows of another number of heads."""
        acting = len(range(self.num_heads)[heads])
        if not (np.ndim(obs) == np.ndim(goal) == 3 and len(obs) == len(goal) == acting):
            shapes = f"obs is {np.shape(obs)} and goal {np.shape(goal)}"
            raise ValueError(f"{shapes}, and must be ({acting}, rows of each head, numbers)")
        return self.actor.all_heads(self._state(obs, goal), heads).cpu().numpy()

    @torch.no_grad()
    def value(self, obs: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Q_k(s, μ_k(s, g), g), what head k expects of its own policy. (K, E, ...) -> (K, E)."""
        state = self._state(obs, goal)
        q = self.critic.all_heads(torch.cat([state, self.actor.all_heads(state)], -1))
        return q.squeeze(-1).cpu().numpy()

    def q_variance(self, obs: np.ndarray, action: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Section 4.2: σ² over the K critics of Q_k(s, a, g), the variance that Eq. (4) turns into
        a priority: the biased one, 1/K Σ_k (Q_k - mean)². (B, O), (B, A), (B, G) -> (B,)."""
        return self._q_variance(self.critic, obs, action, goal)

    @torch.no_grad()
    def snapshot_q_variance(self, map=map) -> Callable[..., np.ndarray]:
        """`q_variance` with the critics as they stand now: a copy of them, which another thread
        can use while `update_heads` changes the originals. It holds until the next call.
        map: such as a thread pool's, for PART rows at a time."""
        here, copied = self.critic, self._critic_snapshot
        torch._foreach_copy_(copied.trunk + copied.stacks, here.trunk + here.stacks)

        def q_variance(obs, action, goal):
            starts = range(PART, len(obs), PART)
            parts = (np.split(x, starts) for x in (obs, action, goal))
            return np.concatenate([*map(partial(self._q_variance, copied), *parts)])

        return q_variance

    @torch.no_grad()
    def _q_variance(self, critic: MultiHeadMLP, obs, action, goal) -> np.ndarray:
        state_action = torch.cat([self._state(obs, goal), self._tensor(action)], -1)
        q = critic.all_heads(state_action).squeeze(-1)  # (K, B)
        return q.var(dim=0, correction=0).cpu().numpy()

    def update_head(self, k: int, batch: dict[str, np.ndarray]) -> torch.Tensor:
        """Algorithm 2, line 16: one DDPG step of head k, Eqs. (2) and (3), conditioned on goals.

        batch: obs (B, O), action (B, A), next_obs (B, O), goal (B, G), reward (B,) and weight (B,).
        It moves head k and both trunks, no other head; both gradients are taken before either step.
        No state is terminal: episodes have a fixed length. Returns critic's and actor's loss, (2,).
        """
        return self.update_heads([k], [batch])[0]

    def update_heads(self, heads: Sequence[int], batches: list[dict], map=map) -> torch.Tensor:
        """`update_head` of n heads, each with a mini-batch of its own, in one step; the trunks
        move by the sum of the heads' gradients (NOTES.md, "Heads in turn or at once").

        map: such as a thread pool's. The heads' gradients do not depend on each other, and are
        added up in the heads' order, so the bits are the same for any number of threads.
        Returns (n, 2), the critic's and the actor's loss of each. ValueError for lists of other
        lengths.
        """
        if len(heads) != len(batches):
            raise ValueError(f"{len(heads)} heads and {len(batches)} mini-batches")
        losses = []
        for k, (loss, gradients) in zip(heads, map(self._gradients, heads, batches), strict=True):
            for p, gradient in zip(self._parameters(k), gradients, strict=True):
                p.grad = gradient if p.grad is None else p.grad.add_(gradient)
            losses.append(loss)
        self._step()
        return torch.stack(losses)

    def _parameters(self, k: int) -> list[torch.Tensor]:
        return [p for net in (self.actor, self.critic) for p in (*net.trunk, *net.own[k])]

    def _gradients(self, k: int, batch: dict[str, np.ndarray]) -> tuple[torch.Tensor, tuple]:
        losses = self._losses(k, batch)  # the two networks have no parameter in common
        return losses.detach(), torch.autograd.grad(losses.sum(), self._parameters(k))

    def _step(self) -> None:
        self.optimizer.step()
        self.optimizer.zero_grad()

    def _losses(self, k: int | slice, batch: dict[str, np.ndarray]) -> torch.Tensor:
        """Eqs. (2) and (3) of head k, (2,), or of some heads, from arrays (n, B, ...): (2, n)."""
        state = self._state(batch["obs"], batch["goal"])  # (B, O+G)
        next_state = self._state(batch["next_obs"], batch["goal"])
        action = self._tensor(batch["action"])
        reward = self._tensor(batch["reward"])[..., None]  # (B, 1)
        weight = self._tensor(batch["weight"])[..., None]

        with torch.no_grad():  # y = r + γ Q̄_k(s', μ̄_k(s', g), g), head k's own targets
            next_action = self.target_actor(k, next_state)
            next_q = self.target_critic(k, torch.cat([next_state, next_action], -1))
            # Rewards are -1 or 0, so every return lies in [-1/(1-γ), 0] (not in the paper).
            target = (reward + self.gamma * next_q).clamp(-1 / (1 - self.gamma), 0)

        # Eq. (2): L(φ_k) = E[w (Q_k(s, a, g) - y)²]
        q = self.critic(k, torch.cat([state, action], -1))
        critic_loss = (weight * (q - target).square()).mean((-2, -1))

        # Eq. (3): maximise E[w Q_k(s, μ_k(s, g), g)] over θ_k, with a penalty on large actions
        policy = self.actor(k, state)
        policy_q = self.critic(k, torch.cat([state, policy], -1), frozen=True)
        actor_loss = -(weight * policy_q).mean((-2, -1))
        actor_loss = actor_loss + self.action_penalty * (weight * policy.square()).mean((-2, -1))
        return torch.stack([critic_loss, actor_loss])

    def update_targets(self) -> None:
        """θ̄ <- polyak·θ̄ + (1 - polyak)·θ, once a cycle FOR EACH HEAD's target network.

        Not in the paper; the released code does so. A head's network is its head and the trunk, so
        the trunk is averaged K times, and K steps of 0.95 are one step of 0.95^K (NOTES.md, "the
        trunk's targets").
        """
        self._move_targets(1 - self.polyak**self.num_heads, head_step=1 - self.polyak)

    @torch.no_grad()
    def _move_targets(self, trunk_step: float, head_step: float) -> None:
        for target, net in ((self.target_actor, self.actor), (self.target_critic, self.critic)):
            torch._foreach_lerp_(target.trunk, net.trunk, trunk_step)
            torch._foreach_lerp_(target.stacks, net.stacks, head_step)

    def state_dict(self) -> dict:
        """Networks, targets, the optimiser's moments and the normaliser, as tensors, not copies."""
        return {
            "networks": [[p.detach() for p in net.trunk + net.stacks] for net in self._networks],
            "optimizer": self.optimizer.state_dict(),
            "normalizer": self.normalizer.state_dict(),
        }

    @torch.no_grad()
    def load_state_dict(self, state: dict) -> None:
        """Take over a `state_dict` of an agent of the same sizes."""
        for net, saved in zip(self._networks, state["networks"], strict=True):
            for p, value in zip(net.trunk + net.stacks, saved, strict=True):
                p.copy_(value)
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))  # it keeps what it gets
        self.normalizer.load_state_dict(state["normalizer"])

    def _tensor(self, x: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(x, dtype=torch.float32, device=self.device)

    def _state(self, obs: np.ndarray, goal: np.ndarray) -> torch.Tensor:
        """The networks' input: [observation | goal], normalised."""
        return self.normalizer(torch.cat([self._tensor(obs), self._tensor(goal)], -1))
