"""HEREBP: energy-based prioritization of hindsight experience (Zhao and Tresp, 2018).

Episodes in which the object was given much energy are replayed more often; within an episode
transitions and goals are drawn as in HER. Section 5.1 of the VCP paper compares with it.

Letters in the shape comments:
    N episodes    T steps of an episode    G goal    P points
"""

import numpy as np

from baselines.her import HERReplay
from her import Batch, EpisodeBuffer, relabel_future

GRAVITY = 9.81  # m/s²; masses are 1 kg and moments of inertia 1 kg·m²
# J, by the environment's name: the original's README for FetchPickAndPlace and the Hand with an
# object; here all of Fetch, and HandReach too
MOST_PER_STEP = {"Fetch": 0.5, "Hand": 2.5}
EPSILON = 1e-6  # J, so that episodes without any energy can be drawn too (ours)


def rotation(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The angle in radians, 0 to π, between orientations: unit quaternions (..., 4) -> (...).
    q and -q are the same orientation, hence the absolute value."""
    return 2 * np.arccos(np.minimum(abs((before * after).sum(axis=-1)), 1))


def trajectory_energy(
    achieved_goal: np.ndarray, dt: float, most_per_step: float = np.inf
) -> np.ndarray:
    """The energy in J that the object gained over each episode, losses not counted against gains.

    achieved_goal: (N, T+1, G). What its numbers are follows from G: a multiple of 3 is points in
        space (Fetch: 1, HandReach: 5 fingertips, whose energies are added), 7 a position and a
        quaternion, anything else coordinates in a plane, which have no height.
    dt: seconds between steps; most_per_step: what counts at most of one step's gain.
    """
    x = np.asarray(achieved_goal, dtype=np.float64)
    goal_dim = x.shape[-1]
    pose = goal_dim == 7
    position = x[..., :3] if pose else x
    speed = np.diff(position, axis=1) / dt
    energy = 0.5 * np.square(speed).sum(axis=-1)  # KE = ½ m |v|², (N, T)
    if pose or goal_dim % 3 == 0:
        height = position[..., 2::3]  # (N, T+1, P)
        energy += GRAVITY * (height[:, 1:] - height[:, :1]).sum(axis=-1)  # PE = m g (z_t - z_0)
    if pose:
        q = x[..., 3:]
        energy += 0.5 * np.square(rotation(q[:, :-1], q[:, 1:]) / dt)  # RE = ½ I |ω|²
    gain = np.diff(energy, axis=1, prepend=0)  # ΔE_1 = E_1, ΔE_t = E_t - E_{t-1}
    return np.clip(gain, 0, most_per_step).sum(axis=1)


class HEREBP(HERReplay):
    """Episodes are drawn with probability ∝ energy^(1/(temperature + 0.01)), transitions and goals
    in them as in HER. The energy is computed once, when an episode is stored.

    dt: as in `trajectory_energy`.
    """

    def __init__(
        self, buffer: EpisodeBuffer, *, env_name: str, dt: float, temperature=1.0, **at_once
    ):
        super().__init__(buffer, **at_once)
        most_per_step = next(
            (m for k, m in MOST_PER_STEP.items() if env_name.startswith(k)), np.inf
        )
        self.settings = (dt, most_per_step)
        self.exponent = 1 / (temperature + 0.01)
        self.energy = np.zeros(self.buffer.max_episodes)
        self.cumulative = np.empty(0)

    def new_episodes(self, slots: np.ndarray) -> None:
        super().new_episodes(slots)
        achieved = self.buffer.episodes["achieved_goal"][slots]
        self.energy[slots] = trajectory_energy(achieved, *self.settings)
        priority = (self.energy[: self.buffer.size] + EPSILON) ** self.exponent
        cumulative = priority.cumsum()
        self.cumulative = cumulative / cumulative[-1]

    def draw(self, count: int, batch_size: int, rng: np.random.Generator) -> Batch:
        episodes, size = self.buffer.episodes, count * batch_size
        # Inverse transform sampling: the first e with p_1 + ... + p_e > u.
        e = np.searchsorted(self.cumulative, rng.random(size), side="right")
        ratio, reward_fn = self.buffer.relabel_ratio, self.buffer.reward_fn
        return relabel_future(episodes, size, rng, ratio, reward_fn, e)
