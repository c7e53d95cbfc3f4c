"""What an epoch's row of progress.csv is made from, and the bar that shows how far it is."""

import math
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from tqdm import tqdm

from ensemble import EnsembleDDPG
from her import Batch

tqdm.monitor_interval = 0  # its watching thread would outlive a run


class Epoch:
    """Epoch `number` of `epochs`, in so many rounds of collecting or testing."""

    def __init__(self, number: int, epochs: int, rounds: int):
        self.number, self.epochs = number, epochs
        self.seconds: dict[str, float] = defaultdict(float)
        self.successes: list[np.ndarray] = []  # of training episodes, (N,) a cycle
        self.losses: list[torch.Tensor] = []  # of critic and actor, (n, 2) an update of n heads
        self.originals: list[float] = []  # their share in each mini-batch
        self.original_weights: list[float] = []  # their share in its loss, by weight
        self.tests: list[tuple[np.ndarray, np.ndarray]] = []  # success (N,) and Q (K, ...) a round
        # disable=None: no bar where the output is not a terminal
        self.bar = tqdm(desc=f"epoch {number}/{epochs}", total=rounds, leave=False, disable=None)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the wall time of the block to `seconds`, and a step to the bar."""
        start = time.perf_counter()
        try:
            yield
        except BaseException:
            self.bar.close()  # what is said of it gets a line of its own
            raise
        self.seconds[name] += time.perf_counter() - start
        self.bar.update()

    def note(self, losses: torch.Tensor, batches: list[Batch]) -> None:
        """An update of n heads: losses (n, 2) and the mini-batches."""
        self.losses.append(losses)
        for batch in batches:
            original = 1 - batch["hindsight"]
            self.originals.append(original.mean())
            self.original_weights.append((original * batch["weight"]).mean())  # of mean 1

    def row(self, env_steps: int, agent: EnsembleDDPG, replay, wall_seconds: float) -> dict:
        """The row. replay: B_h or another method's. FloatingPointError for NaN or Inf in a loss."""
        self.bar.close()
        critic_loss, actor_loss = torch.cat(self.losses).mean(dim=0).tolist()
        if not math.isfinite(critic_loss + actor_loss):
            raise FloatingPointError(f"NaN or Inf in the losses of epoch {self.number}")
        return {
            "epoch": self.number,
            "env_steps": env_steps,
            "wall_seconds": wall_seconds,
            "test_success_rate": float(np.mean([success for success, _ in self.tests])),
            "train_success_rate": float(np.mean(self.successes)),
            "test_q": float(np.mean([q for _, q in self.tests])),
            "critic_loss": critic_loss,
            "actor_loss": actor_loss,
            **variance_by_kind(agent, replay),
            "batch_original_fraction": float(sum(self.originals) / len(self.originals)),
            "her_buffer_size": replay.size,
            **{f"{name}_seconds": value for name, value in self.seconds.items()},
            "loss_original_fraction": float(sum(self.original_weights) / len(self.originals)),
        }

    def write(self, row: dict) -> None:
        """Print the row in fewer than 80 columns."""
        digits = len(str(self.epochs))
        tqdm.write(
            f"epoch {self.number:{digits}}/{self.epochs}  {row['env_steps']:7d} steps"
            f"  success {row['test_success_rate']:.3f} (training {row['train_success_rate']:.3f})"
            f"  {row['wall_seconds']:.0f} s"
        )


def variance_by_kind(agent: EnsembleDDPG, replay, most: int = 4096) -> dict[str, float]:
    """Figure 4: the mean variance of the critics as they are on the hindsight and the original
    transitions of B_h or, without VCP, of what was drawn last; from about `most` of them, evenly
    spread."""
    every = slice(None, replay.size, max(1, replay.size // most))
    rows = {name: torch.as_tensor(x[every]).cpu().numpy() for name, x in replay.data.items()}
    variance = agent.q_variance(rows["obs"], rows["action"], rows["goal"])
    kinds = {"hindsight": rows["hindsight"], "original": ~rows["hindsight"]}
    return {
        f"variance_{name}": float(variance[kind].mean()) if kind.any() else math.nan
        for name, kind in kinds.items()
    }
