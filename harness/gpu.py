"""What a GPU needs beside the code of ensemble.py and vcp.py: the same numbers, but for rounding.

A GPU computes a large call fast, and every call costs time. So B_h lies on the GPU; heads that step
together are trained in one pass, whose few hundred calls are captured once, as a CUDA graph, and
then made as one; and acting, which is many small calls, stays on the CPU. With `--device cuda`
`assemble` takes the two classes here in place of those that they inherit from; they are called in
the same way.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch

import vcp
from ensemble import EnsembleDDPG
from her import Batch

WARM_UP = 3  # passes before one is captured, as many as in PyTorch's documentation of CUDA graphs


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
        self._importance = IMPORTANCE[importance]
        self.at_once, self.device = at_once, device
        self.own = partial(torch.as_tensor, device=device)
        self._drawn: list[Batch] = []

    def update_priorities(self) -> None:
        super().update_priorities()
        self._drawn = []

    def sample(self, batch_size: int, rng: np.random.Generator) -> Batch:
        """As `vcp.HERBuffer.sample`, as tensors; "hindsight" is float32, 0 or 1."""
        if not len(self.probabilities):
            raise ValueError("B_h has no priorities: call update_priorities() after add()")
        if not self._drawn:
            u = self.own(rng.random((self.at_once, batch_size)))
            i = torch.searchsorted(self._cumulative, u, right=True)  # (at_once, B)
            batch = {name: x[i] for name, x in self.data.items()}
            batch["hindsight"] = batch["hindsight"].float()
            weight = self._importance(self.probabilities[i])
            if self.within_kind:
                kinds = [k.double() for k in (batch["hindsight"], 1 - batch["hindsight"])]
                means = [(weight * k).sum(-1, True) / k.sum(-1, True) for k in kinds]
                weight = weight / torch.where(kinds[0] == 1, *means)
            batch["weight"] = (weight / weight.mean(-1, keepdim=True)).float()
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
        """Forget the captured graph and what the player copied: both are of other weights."""
        self._steps, self._followed = 0, None
        self._graph = None
        # said again after loading, which replaces the groups
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
        """As `EnsembleDDPG.update_heads`. All heads are one pass, which needs no `map`."""
        self._steps += 1
        if [*heads] != [*range(self.num_heads)] or len(batches) != len(heads):
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
