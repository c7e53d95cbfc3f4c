"""DTGSH: diversity-based trajectory and goal selection with hindsight (Dai et al., 2021).

Episodes whose achieved goals change direction are drawn more often, and of the candidates so drawn
a mini-batch keeps a subset with diverse goals: a sample of a k-DPP, a determinantal point process
of fixed size (Kulesza and Taskar, 2011). Section 5.1 of the VCP paper compares with it.

Letters in the shape comments:
    N episodes    T steps of an episode    G goal
    U mini-batches    M candidates for each    S selected of them
"""

import numpy as np
import torch

from baselines.her import HERReplay, goal_part
from her import Batch, EpisodeBuffer, relabel_future

CANDIDATES = 100 / 64  # for each that is selected
SMALLEST = 1e-12  # an eigenvalue's share of the largest; below it is rounding


def trajectory_diversity(achieved_goal: np.ndarray, most: float = np.inf) -> np.ndarray:
    """Σ_t det G_t, limited to `most`, where G_t is the Gram matrix of the achieved goals of steps t
    and t+1, each divided by its length: 1 - cos² of the angle between them, seen from the origin.
    (N, T+1, G) -> (N,). A goal at the origin has no direction, and adds nothing."""
    a = np.asarray(achieved_goal, dtype=np.float64)
    length = np.linalg.norm(a, axis=-1, keepdims=True)
    a = np.divide(a, length, out=np.zeros_like(a), where=length > 0)
    square = np.square(a).sum(axis=-1)  # 1, or 0 at the origin
    dot = (a[:, :-1] * a[:, 1:]).sum(axis=-1)
    determinant = square[:, :-1] * square[:, 1:] - dot**2
    return np.minimum(np.maximum(determinant, 0).sum(axis=1), most)


def choose_eigenvectors(eigenvalues: np.ndarray, k: int, rng: np.random.Generator) -> np.ndarray:
    """Draw k of M eigenvectors with probability ∝ the product of their eigenvalues.
    (U, M) positive -> (U, M) bool with k True in each row.

    Backwards through the elementary symmetric polynomials e_l(λ_1..λ_n): the n-th is taken, when l
    are still wanted, with probability λ_n e_{l-1}(λ_1..λ_{n-1}) / e_l(λ_1..λ_n). In logarithms: the
    products of 64 small eigenvalues are zero in floating point.
    """
    sets, m = eigenvalues.shape
    log_value = np.log(eigenvalues)
    log_e = np.full((m + 1, sets, k + 1), -np.inf)  # [n, :, l]
    log_e[0, :, 0] = 0
    for n in range(1, m + 1):  # e_l(..n) = e_l(..n-1) + λ_n e_{l-1}(..n-1)
        log_e[n] = log_e[n - 1]
        added = log_value[:, n - 1, None] + log_e[n - 1, :, :-1]
        log_e[n, :, 1:] = np.logaddexp(log_e[n - 1, :, 1:], added)
    chosen = np.zeros((sets, m), dtype=bool)
    wanted, row, u = np.full(sets, k), np.arange(sets), rng.random((m, sets))
    for n in range(m, 0, -1):
        with np.errstate(invalid="ignore"):  # -inf - -inf where no more are wanted
            log_p = log_value[:, n - 1] + log_e[n - 1, row, wanted - 1] - log_e[n, row, wanted]
        chosen[:, n - 1] = (wanted > 0) & ((u[n - 1] < np.exp(log_p)) | (wanted == n))
        wanted -= chosen[:, n - 1]
    return chosen


def sample_k_dpp(kernel: np.ndarray, k: int, rng: np.random.Generator) -> np.ndarray:
    """Samples of k-DPPs: sets S of k different items with P(S) = det(L_S) / e_k(λ).

    kernel: L, (U, M, M), symmetric and positive semidefinite. Returns (U, k), items of each set.
    """
    sets, m = kernel.shape[:2]
    eigenvalues, vectors = (x.numpy() for x in torch.linalg.eigh(torch.from_numpy(kernel)))
    # Goals that are equal or close leave eigenvalues of zero, give or take the rounding.
    eigenvalues = np.maximum(eigenvalues, SMALLEST * eigenvalues[:, -1:])
    chosen = choose_eigenvectors(eigenvalues, k, rng)
    vectors = vectors[np.broadcast_to(chosen[:, None], vectors.shape)].reshape(sets, m, k)
    # What is left is the DPP of the projection K = V Vᵀ: take an item with probability ∝ K_ii,
    # condition K on it, and again. Conditioning is a step of Cholesky's decomposition of K, with
    # the item as the pivot; it leaves of the diagonal what the columns so far do not explain.
    projection = vectors @ vectors.transpose(0, 2, 1)
    diagonal = np.einsum("umm->um", projection).copy()
    columns = np.zeros((sets, k, m))
    items, row, u = np.empty((sets, k), dtype=int), np.arange(sets), rng.random((k, sets))
    for s in range(k):
        cumulative = np.maximum(diagonal, 0).cumsum(axis=1)
        i = (cumulative / cumulative[:, -1:] <= u[s, :, None]).sum(axis=1)
        before = columns[row, :s, i]  # (U, s)
        column = projection[row, i] - (before[:, None] @ columns[:, :s])[:, 0]
        column /= np.sqrt(column[row, i])[:, None]
        columns[:, s] = column
        diagonal -= column**2
        diagonal[row, i] = 0
        items[:, s] = i
    return items


class DTGSH(HERReplay):
    """For a mini-batch of S transitions: M = 100/64 S candidates of episodes drawn with probability
    ∝ `trajectory_diversity`, of which `sample_k_dpp` keeps S by the diversity of their goals.

    The kernel is exp(-|g_i - g_j|² / 2σ²), with σ = 0.1 for the Hand and 0.5 elsewhere. Fetch's
    diversities are limited to 0.001. All of this is the original's, which has settings for Fetch
    and the Hand with an object; HandReach gets the Hand's.
    """

    def __init__(self, buffer: EpisodeBuffer, *, env_name: str, **at_once):
        super().__init__(buffer, **at_once)
        self.sigma = 0.1 if env_name.startswith("Hand") else 0.5
        self.most = 0.001 if env_name.startswith("Fetch") else np.inf
        self.goal_part = goal_part(env_name)
        self.diversity = np.zeros(self.buffer.max_episodes)
        self.cumulative = np.empty(0)

    def new_episodes(self, slots: np.ndarray) -> None:
        super().new_episodes(slots)
        achieved = self.buffer.episodes["achieved_goal"][slots][..., self.goal_part]
        self.diversity[slots] = trajectory_diversity(achieved, self.most)
        diversity = self.diversity[: self.buffer.size]
        # Where nothing has ever moved, all episodes are alike.
        cumulative = (diversity if diversity.any() else np.ones_like(diversity)).cumsum()
        self.cumulative = cumulative / cumulative[-1]

    def draw(self, count: int, batch_size: int, rng: np.random.Generator) -> Batch:
        episodes, candidates = self.buffer.episodes, round(CANDIDATES * batch_size)
        size = count * candidates
        e = np.searchsorted(self.cumulative, rng.random(size), side="right")
        # As many original goals among the candidates as there are in a mini-batch of HER.
        relabel_ratio = 1 - batch_size * (1 - self.buffer.relabel_ratio) / candidates
        batch = relabel_future(episodes, size, rng, relabel_ratio, self.buffer.reward_fn, e)

        g = batch["goal"][:, self.goal_part].reshape(count, candidates, -1).astype(np.float64)
        square = np.square(g).sum(axis=-1)  # |g_i - g_j|² = |g_i|² + |g_j|² - 2 g_i·g_j
        distance2 = square[:, :, None] + square[:, None] - 2 * g @ g.transpose(0, 2, 1)
        kernel = np.exp(-np.maximum(distance2, 0) / (2 * self.sigma**2))
        items = sample_k_dpp(kernel, batch_size, rng)
        i = (items + candidates * np.arange(count)[:, None]).reshape(-1)
        return {name: x[i] for name, x in batch.items()}
