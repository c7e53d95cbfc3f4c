"""Value Consistency Prioritization, Section 4: what VCP adds to HER with an ensemble.

`value_consistency_priority` is Eq. (4) with checks, `normalised_priority` without; `HERBuffer` is
B_h with its priorities, and `update_her_buffer` is the body of Algorithm 1, of which `score` is
lines 3-5. These are the method; the rest is DDPG and HER.

Letters in the shape comments:
    N transitions in B_h    B transitions of a mini-batch
"""

from collections.abc import Callable

import numpy as np

from her import Batch, EpisodeBuffer

# σ² of Q_k(s, a, g) over the critics, of obs (B, O), action (B, A) and goal (B, G): (B,)
QVariance = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def value_consistency_priority(
    variance: np.ndarray, temperature: float, eps: float = 1e-6
) -> np.ndarray:
    """Eq. (4) and its normalisation: the probabilities to draw each transition of B_h.

    variance: (N,), σ²_i over the critics; temperature: 𝒯; eps: ε. Returns (N,) float64, which add
    up to 1. FloatingPointError if a variance is NaN or Inf.
    """
    variance = np.asarray(variance, dtype=np.float64)
    if not np.isfinite(variance).all():
        raise FloatingPointError("NaN or Inf in the variance of the Q-values")
    return normalised_priority(variance, temperature, eps)


def normalised_priority(variance, temperature: float, eps: float = 1e-6):
    """`value_consistency_priority` without its checks, of float64 in NumPy's or PyTorch's array.

    The sum inside Eq. (4) is the same for all i, so normalising cancels it, and any other common
    factor may stand in its place. Here it is the largest term: the ratios lie in (0, 1] and one of
    them is 1, so their powers neither overflow nor all vanish, whatever 𝒯 and N are.
    """
    consistency = variance.max() - variance + eps  # σ²_max - σ²_i + ε
    priority = (consistency / consistency.max()) ** temperature  # p_i = (...)^𝒯
    return priority / priority.sum()  # p_i / Σ p


def priority_within_kinds(variance, hindsight, temperature: float):
    """Not in the paper: Eq. (4) among the hindsight of B_h, and again among its originals, each
    kind by its own variances and drawn as often as it stands there. (N,), (N,) bool -> (N,).

    Where the variance of originals is far above the rest, Eq. (4) over both kinds together leaves
    them out (NOTES.md, "Where does the priority help?").
    """
    p = 0 * variance
    for kind in (hindsight, ~hindsight):
        if kind.any():
            share = float(kind.sum()) / len(kind)
            p[kind] = share * normalised_priority(variance[kind], temperature)
    return p


def mean_one_within_kinds(weight: np.ndarray, hindsight: np.ndarray) -> np.ndarray:
    """Loss weights (B,) scaled to mean 1 within each kind, so that p does not count against
    originals a second time. hindsight: (B,) bool."""
    weight = weight.copy()
    for kind in filter(np.any, (hindsight, ~hindsight)):
        weight[kind] /= weight[kind].mean()
    return weight


PRIORITIES = {  # of the rows that B_h holds: the method, Section 5.6's two ablations, and ours
    "consistency": lambda rows, t: normalised_priority(rows["variance"], t),
    "variance": lambda rows, t: normalised_priority(-rows["variance"], t),
    "uniform": lambda rows, t: 0 * rows["variance"] + 1 / len(rows["variance"]),
    "within-kind": lambda rows, t: priority_within_kinds(rows["variance"], rows["hindsight"], t),
}

IMPORTANCE = {  # the loss weight of a drawn transition; scaled to mean 1 in the mini-batch (ours)
    "paper": lambda p: p,  # Section 4.3, literally: w_i = p_i / Σ p
    "inverse": lambda p: 1 / p,  # Schaul et al. (2015b), β = 1: undoes the preference
    "none": np.ones_like,
}


class HERBuffer:
    """B_h of Figure 1(b): relabelled and original transitions, first in first out, each with the
    variance it was scored with and the probability to be drawn.

    Not in the paper: that the oldest go first, and the capacity, in transitions; the released code
    takes what a cycle draws.
    A stored variance is not refreshed: it is as old as the transition's stay in the buffer.
    """

    own = staticmethod(np.asarray)  # how rows are stored: harness/gpu.py has another

    def __init__(
        self, capacity: int, temperature: float, priority="consistency", importance="paper"
    ):
        self.capacity, self.temperature = capacity, temperature
        self._priority, self._importance = PRIORITIES[priority], IMPORTANCE[importance]
        self.within_kind = priority == "within-kind"
        self.size = self._next = 0
        self.data: Batch = {}  # the batch's arrays with `capacity` rows, and "variance"
        self.probabilities = self._cumulative = np.empty(0)  # (size,)

    def add(self, batch: Batch, variance: np.ndarray) -> None:
        """Algorithm 1, line 6: store the mini-batch over the oldest transitions.
        batch: arrays or CPU tensors of B rows each; variance: (B,). ValueError for another shape or
        for more than the capacity, FloatingPointError for a variance that is NaN or Inf."""
        batch = {name: np.asarray(x) for name, x in batch.items()}
        batch["variance"] = np.asarray(variance, dtype=np.float64)  # Eq. (4) is in float64
        rows = batch["variance"].shape
        if len(rows) != 1 or any(x.shape[:1] != rows for x in batch.values()):
            raise ValueError(f"the variance is {rows}, one number for each transition is needed")
        if rows[0] > self.capacity:
            raise ValueError(f"{rows[0]} transitions do not fit into {self.capacity}")
        if not np.isfinite(batch["variance"]).all():
            raise FloatingPointError("NaN or Inf in the variance of the Q-values")
        if not self.data:
            empty = {n: np.empty((self.capacity, *x.shape[1:]), x.dtype) for n, x in batch.items()}
            self.data = {name: self.own(x) for name, x in empty.items()}
        slots = (self._next + np.arange(*rows)) % self.capacity
        for name, x in batch.items():
            self.data[name][slots] = self.own(x)
        self._next = (self._next + rows[0]) % self.capacity
        self.size = min(self.size + rows[0], self.capacity)
        self.probabilities = np.empty(0)  # the older ones no longer hold

    def update_priorities(self) -> None:
        """Algorithm 1, line 7: Eq. (4) over all of B_h, from the stored variances. O(N)."""
        rows = {name: x[: self.size] for name, x in self.data.items()}
        self.probabilities = self._priority(rows, self.temperature)
        cumulative = self.probabilities.cumsum(0)
        self._cumulative = cumulative / cumulative[-1]

    def sample(self, batch_size: int, rng: np.random.Generator) -> Batch:
        """Algorithm 2, line 15: draw with replacement by the normalised priorities, O(log N) each.
        Returns rows of the stored arrays and "weight" (B,) float32, the factor of each in the loss.
        ValueError if `update_priorities` was not called since the last `add`."""
        if not len(self.probabilities):
            raise ValueError("B_h has no priorities: call update_priorities() after add()")
        # Inverse transform sampling: the first i with p_1 + ... + p_i > u.
        i = np.searchsorted(self._cumulative, rng.random(batch_size), side="right")
        batch = {name: x[i] for name, x in self.data.items()}
        weight = self._importance(self.probabilities[i])
        if self.within_kind:
            weight = mean_one_within_kinds(weight, batch["hindsight"])
        batch["weight"] = (weight / weight.mean()).astype(np.float32)
        return batch

    def state_dict(self) -> dict:
        """What a checkpoint keeps of it: the stored rows, and where the next ones go."""
        rows = {name: x[: self.size] for name, x in self.data.items()}
        return {"rows": rows, "next": self._next}

    def load_state_dict(self, state: dict) -> None:
        self.data, self.size, self._next = {}, 0, 0
        if state["rows"]:
            rows = dict(state["rows"])
            self.add(rows, rows.pop("variance"))
            if self.size == self.capacity:
                self._next = state["next"]
            self.update_priorities()


def score(
    original_buffer: EpisodeBuffer,
    q_variance: QVariance,
    batch_size: int,
    rng: np.random.Generator,
) -> tuple[Batch, np.ndarray]:
    """Algorithm 1, lines 3-5. Returns a mini-batch (`EpisodeBuffer.sample`) and its variances (B,).

    It changes nothing, so another thread can do it while the heads are trained, as Algorithm 2,
    line 13, has it, with critics that stand still: `EnsembleDDPG.snapshot_q_variance`.
    """
    batch = original_buffer.sample(batch_size, rng)  # 3-4: from B_o, goals relabelled by 'future'
    # 5: the variance of the K Q-values of each transition
    return batch, q_variance(batch["obs"], batch["action"], batch["goal"])


def update_her_buffer(
    her_buffer: HERBuffer,
    original_buffer: EpisodeBuffer,
    q_variance: QVariance,
    batch_size: int,
    rng: np.random.Generator,
) -> None:
    """Algorithm 1, lines 3-7, once. ValueError if the mini-batch exceeds the capacity of B_h."""
    her_buffer.add(*score(original_buffer, q_variance, batch_size, rng))  # 3-6
    her_buffer.update_priorities()  # 7
