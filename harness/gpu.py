"""What a GPU needs beside the code of ensemble.py and vcp.py: the same numbers, but for rounding.

A GPU is fast at large calls, and slow to ask. So B_h lies on it; heads that step together are
trained in one pass, whose few hundred calls are captured once, as a CUDA graph, and then asked for
as one; and acting, which is many small calls, stays on the CPU. The two classes stand for those
that they are made from, and are called in the same way; `assemble` takes them for `--device cuda`.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch

import vcp
from ensemble import EnsembleDDPG
from her import Batch

WARM_UP = 3  # passes before one is captured, as many as in PyTorch's documentation of CUDA graphs


def priorities(variance: torch.Tensor, temperature: float, eps: float = 1e-6) -> torch.Tensor:
    """`vcp.value_consistency_priority` of a float64 tensor. It does not look for NaN, which is to
    wait for the GPU; `HERBufferOnGPU.add` does, where the variance is still on the CPU."""
    consistency = variance.max() - variance + eps
    priority = (consistency / consistency.max()) ** temperature
    return priority / priority.sum()


def priorities_within_kinds(
    variance: torch.Tensor, hindsight: torch.Tensor, temperature: float
) -> torch.Tensor:
    """`vcp.priority_within_kinds`, without asking the GPU which kinds there are."""
    total = torch.zeros_like(variance)
    for kind in (hindsight, ~hindsight):
        most = variance.masked_fill(~kind, -torch.inf).max()
        consistency = most - variance + 1e-6  # of its own kind; -Inf where there is none
        consistency = torch.where(kind, consistency, 0)
        ratio = (consistency / consistency.max()) ** temperature
        share = torch.where(kind, ratio, 0)
        total += torch.where(kind, kind.double().mean() * share / share.sum(), 0)
    return total


PRIORITIES = {
    "consistency": lambda rows, t: priorities(rows["variance"], t),
    "variance": lambda rows, t: priorities(-rows["variance"], t),
    "uniform": lambda rows, t: torch.full_like(rows["variance"], 1 / len(rows["variance"])),
    "within-kind": lambda rows, t: priorities_within_kinds(rows["variance"], rows["hindsight"], t),
}
IMPORTANCE = {**vcp.IMPORTANCE, "none": torch.ones_like}


class HERBufferOnGPU(vcp.HERBuffer):
    """B_h as tensors on `device`. It draws `at_once` mini-batches at a time, so many as are asked
    for between two calls of `update_priorities`; they are those that `vcp.HERBuffer` draws."""

    def __init__(
        self,
        capacity: int,
        temperature: float,
        priority="consistency",
        importance="paper",
        *,
        at_once: int,
        device: str,
    ):
        super().__init__(capacity, temperature, priority, importance)
        self._priority, self._importance = PRIORITIES[priority], IMPORTANCE[importance]
        self.at_once, self.device = at_once, device
        self._drawn: list[Batch] = []

    def add(self, batch: Batch, variance: np.ndarray) -> None:
        """As `vcp.HERBuffer.add`; FloatingPointError for a variance that is NaN or Inf."""
        variance = np.asarray(variance)
        rows, new = {**batch, "variance": variance}, len(variance)
        if variance.ndim != 1 or any(len(x) != new for x in rows.values()):
            raise ValueError(f"the variance is {variance.shape}, one number for each is needed")
        if new > self.capacity:
            raise ValueError(f"{new} transitions do not fit into {self.capacity}")
        if not np.isfinite(variance).all():
            raise FloatingPointError("NaN or Inf in the variance of the Q-values")
        rows = {name: torch.as_tensor(x, device=self.device) for name, x in rows.items()}
        if not self.data:
            self.data = {
                name: x.new_empty((self.capacity, *x.shape[1:])) for name, x in rows.items()
            }
        slots = (self._next + torch.arange(new, device=self.device)) % self.capacity
        for name, x in rows.items():
            self.data[name][slots] = x
        self._next = (self._next + new) % self.capacity
        self.size = min(self.size + new, self.capacity)
        self.probabilities = np.empty(0)  # the older ones no longer hold

    def update_priorities(self) -> None:
        rows = {name: self.data[name][: self.size] for name in ("variance", "hindsight")}
        rows["variance"] = rows["variance"].double()
        self.probabilities = self._priority(rows, self.temperature)
        cumulative = self.probabilities.cumsum(0)
        self._cumulative = cumulative / cumulative[-1]
        self._drawn = []

    def sample(self, batch_size: int, rng: np.random.Generator) -> Batch:
        """As `vcp.HERBuffer.sample`, as tensors; "hindsight" is 0 or 1."""
        if not len(self.probabilities):
            raise ValueError("B_h has no priorities: call update_priorities() after add()")
        if not self._drawn:
            u = torch.as_tensor(rng.random((self.at_once, batch_size)), device=self.device)
            i = torch.searchsorted(self._cumulative, u, right=True)  # (at_once, B)
            batch = {name: x[i] for name, x in self.data.items()}
            batch["hindsight"] = batch["hindsight"].float()
            weight = self._importance(self.probabilities[i])
            kind = batch["hindsight"] if self.within_kind else torch.zeros_like(weight)
            sums = [
                (weight * k).sum(-1, keepdim=True) / k.sum(-1, keepdim=True)
                for k in (kind, 1 - kind)
            ]
            batch["weight"] = (weight / torch.where(kind == 1, *sums)).float()
            self._drawn = [{n: x[j] for n, x in batch.items()} for j in range(self.at_once)]
        return self._drawn.pop(0)

    def state_dict(self) -> dict:
        rows = {name: x[: self.size].cpu() for name, x in self.data.items()}
        return {"rows": rows, "next": self._next}


class EnsembleOnGPU(EnsembleDDPG):
    """`EnsembleDDPG` on a GPU; where not all heads step together, they are trained one by one."""

    def __init__(self, *sizes, **settings):
        super().__init__(*sizes, **settings)
        self._player = EnsembleDDPG(*sizes, **{**settings, "device": "cpu"})
        self._batch = None
        self._begin()

    def _begin(self) -> None:
        """What is captured or copied is not any more that of the networks or the optimiser."""
        self._steps, self._followed = 0, None
        self._graph = None
        self.optimizer.param_groups[0]["capturable"] = self.device.type == "cuda"

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        self._begin()

    def snapshot_q_variance(self, map=map) -> Callable[..., np.ndarray]:
        """As `EnsembleDDPG.snapshot_q_variance`, of all rows in one call."""
        super().snapshot_q_variance()
        return partial(self._q_variance, self._critic_snapshot)

    @torch.no_grad()
    def act(self, obs: np.ndarray, goal: np.ndarray, heads: slice = slice(None)) -> np.ndarray:
        now = (self._steps, self.normalizer.count)
        if self._followed != now:
            here, there = self.actor, self._player.actor
            for p, q in zip(there.trunk + there.stacks, here.trunk + here.stacks, strict=True):
                p.copy_(q)
            self._player.normalizer.mean.copy_(self.normalizer.mean)
            self._player.normalizer.std.copy_(self.normalizer.std)
            self._followed = now
        return self._player.act(obs, goal, heads)

    def update_heads(self, heads: Sequence[int], batches: list[Batch], map=map) -> torch.Tensor:
        self._steps += 1
        if [*heads] != [*range(self.num_heads)]:
            return super().update_heads(heads, batches)
        rows = {
            name: torch.stack([torch.as_tensor(batch[name]) for batch in batches])
            for name in ("obs", "action", "next_obs", "goal", "reward", "weight")
        }
        if self._batch is None:
            self._batch = {name: self._tensor(x) for name, x in rows.items()}
        for name, x in rows.items():
            self._batch[name].copy_(x)
        if self.device.type == "cpu":  # in tests
            return self._all_heads().T
        if self._steps <= WARM_UP:
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                losses = self._all_heads()
            torch.cuda.current_stream().wait_stream(stream)
            return losses.T
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            # Algorithm 1's thread goes on meanwhile
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self._captured_losses = self._all_heads()
        self._graph.replay()
        return self._captured_losses.T.clone()

    def _all_heads(self) -> torch.Tensor:
        """A step of all heads in one pass, each with its rows of `_batch`. Returns (2, K)."""
        losses = self._losses(slice(None), self._batch)
        losses.sum().backward()
        self._step()
        return losses.detach()
