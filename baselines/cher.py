"""CHER: curriculum-guided hindsight experience replay (Fang et al., 2019).

Of twice as many relabelled candidates, a mini-batch keeps those whose goals are diverse and near
to what was achieved; over an epoch, being near counts for more and more. Section 5.1 of the VCP
paper compares with it.

Letters in the shape comments:
    U mini-batches    M candidates for each    S selected of them    G goal
"""

import numpy as np

from baselines.her import HERReplay, goal_part
from her import Batch, EpisodeBuffer, relabel_future

GROWTH = 1e-4  # of λ, with each update
TRIO = 3  # candidates that are looked at for one to be taken


def coverage(goal: np.ndarray) -> np.ndarray:
    """What each goal adds to the diversity of a selection. (U, M, G) -> (U, M).

    The diversity is a facility location, Σ_i max_{j selected} sim_ij, on the graph that links each
    goal i to its nearest neighbour alone, with sim_i = exp(-d_i² / mean(d)²). One link each leaves
    the maximum nothing to choose from, so j adds Σ sim_i over the i whose neighbour j is, whatever
    else is selected.
    """
    gain = np.empty(goal.shape[:2])
    for u, x in enumerate(goal.astype(np.float64)):
        # |x_i - x_j|² - |x_i|² = |x_j|² - 2 x_i·x_j, as one product; it has the same nearest j
        square = np.square(x).sum(axis=1)[:, None]
        apart = np.hstack([-2 * x, np.ones_like(square)]) @ np.hstack([x, square]).T
        np.fill_diagonal(apart, np.inf)
        neighbour = apart.argmin(axis=1)
        d = np.sqrt(np.square(x - x[neighbour]).sum(axis=1))
        scale = d.mean() or 1.0  # all goals equal: d = 0 and sim = 1
        similarity = np.exp(-np.square(d / scale))
        gain[u] = np.bincount(neighbour, similarity, minlength=len(x))
    return gain


def select(
    goal: np.ndarray,
    achieved: np.ndarray,
    selected: int,
    proximity: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Stochastic greedy maximisation of diversity - λ Σ distance: S times, draw three different
    remaining candidates, take the best of them.

    goal, achieved: (U, M, G), of each candidate the relabelled goal and what was achieved then.
    selected: S, at most M - 2. proximity: λ for each mini-batch, (U,).
    Returns the chosen candidates, (U, S).
    """
    sets, candidates = goal.shape[:2]
    gain = coverage(goal)
    cost = proximity[:, None] * np.sqrt(np.square(goal - achieved).sum(axis=-1))
    # Three different places among the r that remain, for all steps at once: the second and third
    # are drawn from fewer places and step over those before them.
    r = candidates - np.arange(selected)
    first, second, third = (rng.integers(r - i, size=(sets, selected)) for i in range(TRIO))
    second += second >= first
    low, high = np.minimum(first, second), np.maximum(first, second)
    third += third >= low
    third += third >= high
    places = np.stack([first, second, third])  # (3, U, S)

    remaining = np.tile(np.arange(candidates), (sets, 1))
    chosen = np.empty((sets, selected), dtype=int)
    row = np.arange(sets)
    for s in range(selected):
        place = places[:, :, s]
        trio = remaining[row, place]  # (3, U)
        value = gain[row, trio] - cost[row, trio]
        best = value.argmax(axis=0)
        chosen[:, s] = trio[best, row]
        # The last of those that remain moves to the place of the one that leaves.
        remaining[row, place[best, row]] = remaining[:, r[s] - 1]
    return chosen


class CHER(HERReplay):
    """For a mini-batch of S transitions, M = 2 S candidates as in HER, of which `select` keeps S.

    λ = (1 + 10⁻⁴)^τ, where τ counts the updates of an epoch: λ starts each epoch at 1 and is 1.22
    after 2,000 updates. All heads of an ensemble update share a τ, so that λ does not grow K times
    as fast.

    heads: K; updates: of all heads, in an epoch.
    """

    def __init__(
        self, buffer: EpisodeBuffer, *, env_name: str, heads: int, updates: int, **at_once
    ):
        super().__init__(buffer, **at_once)
        self.goal_part = goal_part(env_name)
        self.heads, self.updates, self.drawn = heads, updates, 0

    def draw(self, count: int, batch_size: int, rng: np.random.Generator) -> Batch:
        episodes, candidates = self.buffer.episodes, 2 * batch_size
        n, horizon = episodes["action"].shape[:2]
        size = count * candidates
        e, t = rng.integers(n, size=size), rng.integers(horizon, size=size)
        ratio, reward_fn = self.buffer.relabel_ratio, self.buffer.reward_fn
        batch = relabel_future(episodes, size, rng, ratio, reward_fn, e, t)

        def by_batch(x):
            return x[:, self.goal_part].reshape(count, candidates, -1)

        tau = (self.drawn + np.arange(count)) // self.heads % self.updates
        self.drawn += count
        achieved = by_batch(episodes["achieved_goal"][e, t])
        proximity = (1 + GROWTH) ** tau
        chosen = select(by_batch(batch["goal"]), achieved, batch_size, proximity, rng)
        i = (chosen + candidates * np.arange(count)[:, None]).reshape(-1)
        return {name: x[i] for name, x in batch.items()}
