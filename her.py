"""Hindsight Experience Replay (Andrychowicz et al., 2017): the original buffer B_o and 'future'.

Letters in the shape comments:
    N episodes    T steps of an episode    B transitions    O observation    G goal    A action
"""

from collections.abc import Callable

import numpy as np

Batch = dict[str, np.ndarray]
RewardFn = Callable[[np.ndarray, np.ndarray], np.ndarray]


class EpisodeBuffer:
    """B_o of Figure 1(b): whole episodes of a fixed length T, with the goals they were played for.

    episodes["obs"] (N, T+1, O), ["achieved_goal"] (N, T+1, G), ["desired_goal"] (N, G) and
    ["action"] (N, T, A), float32. No reward is stored: Eq. (1) gives it when it is needed.
    capacity: in transitions (Appendix B: 1e6); ValueError if it holds no whole episode.
    relabel_ratio, reward_fn: those of `relabel_future`.
    """

    def __init__(
        self,
        capacity: int,
        horizon: int,
        obs_dim: int,
        goal_dim: int,
        action_dim: int,
        relabel_ratio: float,
        reward_fn: RewardFn,
    ):
        if capacity < horizon:
            raise ValueError(f"a buffer of {capacity} transitions holds no episode of {horizon}")
        self.max_episodes, self.size = capacity // horizon, 0
        self.relabel_ratio, self.reward_fn = relabel_ratio, reward_fn
        shapes = {
            "obs": (horizon + 1, obs_dim),
            "achieved_goal": (horizon + 1, goal_dim),
            "desired_goal": (goal_dim,),
            "action": (horizon, action_dim),
        }
        self._data = {k: np.empty((self.max_episodes, *s), np.float32) for k, s in shapes.items()}

    @property
    def episodes(self) -> dict[str, np.ndarray]:
        """What is stored, as views: see the class for the shapes."""
        return {name: array[: self.size] for name, array in self._data.items()}

    def add(self, episodes: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """Algorithm 2, line 9, for whole episodes. Once full, random old episodes make room (not in
        the paper; HER's code does so). Returns the rows they went to. ValueError for more
        episodes than the buffer holds, and for an array of another shape."""
        new = len(episodes["action"])
        for name, array in self._data.items():
            shape, needed = np.shape(episodes[name]), (new, *array.shape[1:])
            if shape != needed:
                raise ValueError(f'episodes["{name}"] is {shape}, and must be {needed}')
        if new > self.max_episodes:
            raise ValueError(f"{new} episodes do not fit into a buffer of {self.max_episodes}")
        free = min(new, self.max_episodes - self.size)
        slots = np.arange(self.size, self.size + free)
        if free < new:
            overwritten = rng.choice(self.size, new - free, replace=False)
            slots = np.concatenate([slots, overwritten])
        for name, array in self._data.items():
            array[slots] = episodes[name]
        self.size += free
        return slots

    def sample(self, batch_size: int, rng: np.random.Generator) -> Batch:
        """Algorithm 1, lines 3-4: a mini-batch, its goals relabelled by `relabel_future`."""
        return relabel_future(self.episodes, batch_size, rng, self.relabel_ratio, self.reward_fn)


def relabel_future(
    episodes: dict[str, np.ndarray],
    batch_size: int,
    rng: np.random.Generator,
    relabel_ratio: float,
    reward_fn: RewardFn,
    e: np.ndarray | None = None,
    t: np.ndarray | None = None,
) -> Batch:
    """Section 3.2 and Algorithm 1, lines 3-4: draw transitions, replace goals by achieved ones.

    episodes: arrays as in `EpisodeBuffer`.
    relabel_ratio: probability that a transition gets a new goal. HER's k = 4 additional goals
        (Appendix B) is the ratio k/(1+k) = 0.8; nothing is stored k times.
    reward_fn: Eq. (1), vectorised: (B, G) achieved and (B, G) desired goals -> (B,) of -1 and 0.
    e, t: the episode and the step of each transition, (B,); what is not given is drawn uniformly.
    Returns obs (B, O), action (B, A), next_obs (B, O), goal (B, G), reward (B,) and hindsight (B,),
        a bool.
    FloatingPointError for a reward that is NaN or Inf; ValueError for rewards of another shape or
        beyond -1 and 0, by which `EnsembleDDPG` clips its targets.
    """
    n, horizon = episodes["action"].shape[:2]
    e = rng.integers(n, size=batch_size) if e is None else e
    t = rng.integers(horizon, size=batch_size) if t is None else t  # 0 .. T-1
    achieved = episodes["achieved_goal"]
    hindsight = rng.random(batch_size) < relabel_ratio
    future = rng.integers(t + 1, horizon + 1)  # t' ~ U{t+1, ..., T}
    goal = np.where(hindsight[:, None], achieved[e, future], episodes["desired_goal"][e])
    # r(s, a, g) asks whether the action led to the goal, so it reads the NEXT achieved goal.
    reward = np.asarray(reward_fn(achieved[e, t + 1], goal), dtype=np.float32)
    if reward.shape != e.shape:
        raise ValueError(
            f"reward_fn of {goal.shape} goals gave {reward.shape}, not {e.shape} rewards"
        )
    if not np.isfinite(reward).all():
        raise FloatingPointError("NaN or Inf in the rewards")
    if reward.max(initial=-1) > 0 or reward.min(initial=0) < -1:
        raise ValueError(f"reward_fn gave {reward.min()} to {reward.max()}, not Eq. (1)'s -1 and 0")
    return {
        "obs": episodes["obs"][e, t],
        "action": episodes["action"][e, t],
        "next_obs": episodes["obs"][e, t + 1],  # with the same goal as obs
        "goal": goal,
        "reward": reward,
        "hindsight": hindsight,
    }
