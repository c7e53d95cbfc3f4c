"""The border to an environment, which is somebody else's program: all of it is called here.

`asked` makes one line of whatever it raises. `Border` hands out copies and takes copies in, looks
at every observation, reward and success, and compares the rewards of an episode with those that
replay will compute again.
"""

import random
import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from harness.errors import EnvironmentFailed

KEYS = ("observation", "achieved_goal", "desired_goal")
PEN = "ignore_z_target_rotation"  # what a Pen task has and the others of its kind have not


def asked(name: str, method: str, function: Callable, *args, **kwargs) -> Any:
    """function(*args, **kwargs), where it is code of the environment `name`. EnvironmentFailed, one
    line, for whatever it raises; sys.exit() too, which would end the run without a word."""
    try:
        return function(*args, **kwargs)
    except EnvironmentFailed:
        raise
    except (Exception, SystemExit) as error:
        raise EnvironmentFailed(f"{name}: its {method} raised {said(error)}") from error


def said(error: BaseException) -> str:
    """An error in one line."""
    message = " ".join(str(error).split()).rstrip(".")
    return f"{type(error).__name__}: {message}".rstrip(": ")


@cache
def remark(text: str) -> None:
    """A line on stderr, once in a process."""
    print(f"run.py: {text}", file=sys.stderr)


def picture(frame: Any) -> np.ndarray:
    """A copy of what `render` gave, (height, width, 3) uint8. ValueError if it is no picture."""
    if frame is None:
        raise ValueError("no picture but None")
    frame = np.array(frame)
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3 or not frame.size:
        raise ValueError(f"no picture (height, width, 3) of uint8 but {frame.shape} {frame.dtype}")
    return frame


class Border(gym.Wrapper):
    """A goal environment as the rest of the project sees it.

    Observations are float32 copies of their spaces' shapes, rewards are the -1 and 0 of Eq. (1),
    info["is_success"] says whether the goal is reached: the environment's own word or, without one,
    the reward's. An episode that ends at success is played on, as all have one length.
    EnvironmentFailed, one line with the name and the method, for what is raised, and for what would
    be learned wrongly without a word: other shapes or types, NaN and Inf, a goal that moves, an end
    before the last step that is no success, and a reward that `compute_reward` does not give again
    at the episode's end and after the next reset.
    """

    def __init__(self, env: gym.Env, name: str):
        super().__init__(env)
        self.name, self.horizon, self.t = name, env.spec.max_episode_steps, 0
        self.shapes = {key: env.observation_space[key].shape for key in KEYS}
        ends = np.cumsum([0, *(shape[0] for shape in self.shapes.values())])
        self.places = {key: slice(*ends[i : i + 2]) for i, key in enumerate(KEYS)}
        self.obs_dim, self.goal_dim, _ = (shape[0] for shape in self.shapes.values())
        self.action_dim = env.action_space.shape[0]
        # The Pen tasks' compute_reward gives something else for a batch than for a pair, in
        # gymnasium-robotics as in the gym of the paper (NOTES.md, "The Pen tasks' reward").
        self.is_pen = bool(asked(name, "class", getattr, env.unwrapped, PEN, False))
        # seconds of a step; 1 where the environment does not say
        self.dt = asked(name, "dt", lambda: float(getattr(env.unwrapped, "dt", 1)))
        self.episode = ([], [], [])  # its goal, what was achieved in each step, the rewards
        self.best = self._best_reward()

    def failed(self, problem: str) -> EnvironmentFailed:
        return EnvironmentFailed(f"{self.name}: {problem}")

    def _best_reward(self) -> float:
        """Eq. (1)'s reward where the goal is reached: 0, or 1 where those of the environment are 0
        and 1. It is asked for a goal that is reached and, twice, for another."""
        obs, _ = self.reset()
        achieved = np.stack([obs["achieved_goal"]] * 3)
        desired = np.stack([obs["achieved_goal"], obs["desired_goal"], obs["desired_goal"]])
        try:
            rewards = self._asked_for(achieved, desired)
        except EnvironmentFailed as error:
            why = said(error.__cause__)
            problem = f"its compute_reward does not take a batch of goals and no info ({why})"
            raise self.failed(problem) from error
        for best in (0, 1):
            if rewards.shape == (3,) and rewards[0] == best and set(rewards) <= {best - 1, best}:
                return float(rewards[0])
        wanted = (
            "its compute_reward must give -1 and 0 (reached), or 0 and 1, of many pairs at once"
        )
        raise self.failed(
            f"{wanted}: for three pairs, the first of them reached, it gave {rewards.tolist()}"
        )

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """With a seed, Python's and NumPy's global generators get it too: some environments draw
        from them, and processes that start alike would all draw the same."""
        if seed is not None:
            random.seed(seed)
            np.random.seed(seed % 2**32)  # noqa: NPY002
        return asked(self.name, "reset", self._reset, seed, options)

    def _reset(self, seed, options):
        obs, info = self.env.reset(seed=seed, options=options)
        self.compare(self.episode)
        self.t, self.ended = 0, False
        taken = self._taken(obs)
        self.episode = (np.array(obs["desired_goal"]), [], [])
        self._goal = taken["desired_goal"].tobytes()
        return taken, info

    def step(self, action: np.ndarray):
        return asked(self.name, "step", self._step, np.array(action))

    def _step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.t += 1
        taken, reward = self._taken(obs), float(reward) - self.best
        if reward not in (-1, 0):
            raise self.failed(f"step {self.t} gave the reward {reward + self.best:g}")
        success = info.get("is_success", reward == 0)
        if success not in (0, 1):
            raise self.failed(f"is_success of step {self.t} is {success!r}, not True or False")
        if taken["desired_goal"].tobytes() != self._goal:
            raise self.failed(
                f"its goal moved in step {self.t}; it must stand still for an episode"
            )
        _, achieved, rewards = self.episode
        achieved.append(np.array(obs["achieved_goal"]))
        rewards.append(reward)
        if self.t >= self.horizon:
            self.compare(self.episode)
        elif truncated:
            cut = f"it cut an episode off after {self.t} of {self.horizon} steps"
            raise self.failed(f"{cut}; try --episode-length {self.t}")
        elif terminated and not (success or self.ended):
            ended = f"an episode ended in step {self.t} of {self.horizon} without success"
            raise self.failed(f"{ended}; episodes here have one length")
        self.ended = bool(terminated)  # some go on saying so after a success
        return taken, reward, terminated, truncated, {**info, "is_success": bool(success)}

    def _taken(self, obs: dict) -> dict[str, np.ndarray]:
        """Copies, as B_o stores them."""
        for key, shape in self.shapes.items():
            if np.shape(obs[key]) != shape:
                now = f"its {key} is {np.shape(obs[key])} after step {self.t}"
                raise self.failed(f"{now}, its space says {shape}")
        parts = [obs[key] for key in KEYS]
        numbers = np.concatenate(parts, dtype=np.float64, casting="unsafe")
        if not np.abs(numbers).max() < 1e38:  # NaN, Inf, and what float32 does not hold
            key = next(
                key for key, x in zip(KEYS, parts, strict=True) if not np.max(np.abs(x)) < 1e38
            )
            raise self.failed(f"NaN or Inf in its {key} after step {self.t}")
        numbers = numbers.astype(np.float32)
        return {key: numbers[where] for key, where in self.places.items()}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info=None) -> np.ndarray:
        """Eq. (1) of many pairs of goals, (B, G) and (B, G) -> (B,) of -1 and 0."""
        rewards = self._asked_for(achieved, desired) - self.best
        if rewards.shape != achieved.shape[:-1]:
            problem = f"its compute_reward of {achieved.shape} goals gave {rewards.shape} rewards"
            raise self.failed(problem)
        other = rewards[(rewards != 0) & (rewards != -1)]  # NaN too
        if other.size:
            raise self.failed(f"its compute_reward gave {other[0] + self.best:g}")
        return rewards

    def _asked_for(self, achieved, desired):
        def ask():
            compute_reward = self.env.get_wrapper_attr("compute_reward")
            goals = np.array(achieved), np.array(desired)  # which it may change
            return np.asarray(compute_reward(*goals, {}), dtype=float)

        return asked(self.name, "compute_reward", ask)

    def compare(self, episode: tuple, dtype=None) -> None:
        """Compute the rewards of an `episode` again, from its goals as they were or as `dtype`.
        EnvironmentFailed if one is not the step's."""
        goal, achieved, rewards = episode
        if self.is_pen or not rewards:
            return
        achieved = np.array(achieved, dtype)
        desired = np.broadcast_to(np.asarray(goal, dtype), achieved.shape)
        again = self.compute_reward(achieved, desired)
        for t in np.flatnonzero(again != rewards)[:1]:
            given, now = rewards[t] + self.best, again[t] + self.best
            raise self.failed(
                f"step {t + 1} gave the reward {given:g}, and compute_reward of what it observed"
                f" gives {now:g} (it may depend on the goals alone; a wrapper that changes either"
                " needs a compute_reward of its own)"
            )

    def render(self) -> np.ndarray | None:
        """A picture (height, width, 3) uint8 or, in a window, None."""
        if self.render_mode == "human":
            return asked(self.name, "render", self.env.render)
        return asked(self.name, "render", lambda: picture(self.env.render()))

    def close(self) -> None:
        """What it raises is said on stderr, and changes nothing: all has been done by then."""
        try:
            asked(self.name, "close", self.env.close)
        except EnvironmentFailed as error:
            remark(str(error))


def refuse_spaces(env: gym.Env, name: str) -> None:
    """EnvironmentFailed for an environment with whose spaces nothing can be learned."""
    space, action = env.observation_space, env.action_space

    def refuse(problem: str, wrong: bool) -> None:
        if wrong:
            raise EnvironmentFailed(f"{name}: {problem}")

    keys = ", ".join(KEYS)
    goals = isinstance(space, gym.spaces.Dict) and set(KEYS) <= set(space.keys())
    refuse(f"it has no goals (its observation is not a dict of {keys})", not goals)
    flat = all(isinstance(space[k], Box) and len(space[k].shape) == 1 for k in KEYS)
    flat = flat and min(space[k].shape[0] for k in KEYS) > 0
    refuse(f"its {keys} are not all flat Boxes", not flat)
    same = space["achieved_goal"].shape == space["desired_goal"].shape
    refuse("its achieved_goal and desired_goal differ in size", not same)
    flat = isinstance(action, Box) and len(action.shape) == 1 and action.shape[0]
    refuse(f"its action space is {action}, not a flat Box", not flat)
    whole = not np.issubdtype(action.dtype, np.floating)
    refuse(f"its actions are whole numbers ({action}), not real ones", whole)
    with np.errstate(over="ignore"):
        width = np.float32(action.high) - np.float32(action.low)
    bounds = f"its actions need bounds a finite width apart in float32 ({action})"
    refuse(bounds, not (np.isfinite(width) & (width > 0)).all())
    length = "it has no episode length; give one, such as --episode-length 50"
    refuse(length, env.spec.max_episode_steps is None)
    named = env.has_wrapper_attr("compute_reward") and env.get_wrapper_attr("compute_reward")
    refuse("it has no compute_reward(achieved_goal, desired_goal, info)", not callable(named))
