"""The tasks: the paper's sixteen names (Appendix A), and any other goal environment."""

import contextlib
import difflib
import io
import itertools
from dataclasses import dataclass

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.spaces import Box

import envs_point  # noqa: F401, it registers PointMass and SparseReacher
from harness.errors import UsageError
from her import RewardFn

with contextlib.redirect_stderr(io.StringIO()):  # it prints a notice about other environments
    import gymnasium_robotics
gym.register_envs(gymnasium_robotics)

PAPER_LENGTH = 50  # T, for all sixteen; today's Hand manipulation tasks stop at 100 by themselves
PAPER_ENVS = {  # the paper's name -> today's id
    "FetchReach-v1": "FetchReach-v4",
    "FetchPush-v1": "FetchPush-v4",
    "FetchSlide-v1": "FetchSlide-v4",
    "FetchPickAndPlace-v1": "FetchPickAndPlace-v4",
    "HandReach-v0": "HandReach-v3",
    "HandManipulatePenFull-v0": "HandManipulatePenFull-v1",
    "HandManipulatePenRotate-v0": "HandManipulatePenRotate-v1",
    "HandManipulateEggFull-v0": "HandManipulateEggFull-v1",
    "HandManipulateEggRotate-v0": "HandManipulateEggRotate-v1",
    "HandManipulateBlockFull-v0": "HandManipulateBlockFull-v1",
    "HandManipulateBlockRotateParallel-v0": "HandManipulateBlockRotateParallel-v1",
    "HandManipulateBlockRotateXYZ-v0": "HandManipulateBlockRotateXYZ-v1",
    "HandManipulateBlockRotateZ-v0": "HandManipulateBlockRotateZ-v1",
    "Reacher-v2": "SparseReacher-v1",
    "PointMassEmptyEnv-v1": "PointMassEmptyEnv-v1",
    "PointMassWallEnv-v1": "PointMassWallEnv-v1",
}
MISSPELT = {  # as Appendix A prints two of them
    "FetchSilce-v1": "FetchSlide-v1",
    "FetchPickAndPlac-v1": "FetchPickAndPlace-v1",
}


KEYS = ("observation", "achieved_goal", "desired_goal")
MOST_LOOKED_AT = 8  # episodes, by `examine`
CLIP = 200  # what lies beyond is one and the same to the networks (ensemble.Normalizer)


@dataclass(frozen=True)
class Task:
    """What the algorithm needs to know of an environment."""

    name: str  # as `make_env` takes it
    made: str  # one line: what that is today
    horizon: int  # T
    obs_dim: int
    goal_dim: int
    action_dim: int
    dt: float  # seconds of a step; 1 where the environment does not say
    reward_fn: RewardFn  # Eq. (1): (B, G) achieved and (B, G) desired goals -> (B,) of -1 and 0


class MinusOne(gym.Wrapper):
    """Rewards of 0 and 1 (reached) as the -1 and 0 of Eq. (1)."""

    def step(self, action):
        obs, reward, *rest = self.env.step(action)
        return obs, reward - 1, *rest

    def compute_reward(self, achieved_goal, desired_goal, info):
        its = self.env.get_wrapper_attr("compute_reward")
        return np.asarray(its(achieved_goal, desired_goal, info)) - 1


def reward_of(env: gym.Env) -> RewardFn:
    """Eq. (1) as the environment computes it, or the outermost wrapper with one of its own."""
    compute_reward = env.get_wrapper_attr("compute_reward")
    return lambda achieved, desired: np.asarray(compute_reward(achieved, desired, {}))


def make_env(name: str, episode_length: int | None = None, **kwargs) -> gym.Env:
    """Make a goal environment by the paper's name, by a current id or as module:ID.

    Its episodes have `episode_length` steps or, without one, 50 for the paper's names and their own
    length for all others. Actions are rescaled to [-1, 1]; rewards of 0 and 1 become -1 and 0.
    kwargs go to the environment. UsageError, one line, for an unknown name, for what raises an
    error, and for what this method cannot learn: no goals, no Box of actions, no vectorised
    `compute_reward` of -1 and 0, no episode length.
    """
    name = MISSPELT.get(name, name)
    length = episode_length or (PAPER_LENGTH if name in PAPER_ENVS else None)
    made = PAPER_ENVS.get(name, name)
    try:
        env = gym.make(made, max_episode_steps=length, disable_env_checker=True, **kwargs)
    except Exception as error:  # a user's module may raise anything
        ids = [i for i, spec in gym.registry.items() if "obotics" in str(spec.entry_point)]
        close = difflib.get_close_matches(name, {*PAPER_ENVS, *ids}, n=3, cutoff=0.5)
        known = isinstance(error, gym.error.Error) and close
        hint = f"; the nearest names are {', '.join(close)}" if known else ""
        message = f"cannot make the environment {name}: {_said(error)}{hint}"
        raise UsageError(message) from error
    try:
        problem = _what_is_missing(env)
    except Exception as error:
        problem = f"its reset raised {_said(error)}"
    if problem:
        env.close()
        raise UsageError(f"cannot learn in the environment {name}: {problem}")
    if not (np.all(env.action_space.low == -1) and np.all(env.action_space.high == 1)):
        env = gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    return env if _three_rewards(env)[0] == 0 else MinusOne(env)


def _said(error: Exception) -> str:
    """An error in one line."""
    message = " ".join(str(error).split()).rstrip(".")
    expected = isinstance(error, (gym.error.Error, ModuleNotFoundError))
    return message if expected else f"{type(error).__name__}: {message}".rstrip(": ")


def _what_is_missing(env: gym.Env) -> str | None:
    space, action = env.observation_space, env.action_space
    if not (isinstance(space, gym.spaces.Dict) and set(KEYS) <= set(space.keys())):
        return f"it has no goals (its observation is not a dict of {', '.join(KEYS)})"
    if not all(isinstance(space[k], Box) and len(space[k].shape) == 1 for k in KEYS):
        return f"its {', '.join(KEYS)} are not all flat Boxes"
    if space["achieved_goal"].shape != space["desired_goal"].shape:
        return "its achieved_goal and desired_goal differ in size"
    if not (isinstance(action, Box) and len(action.shape) == 1 and action.shape[0]):
        return f"its action space is {action}, not a flat Box"
    if not action.is_bounded():
        return f"its actions have no bounds ({action})"
    if not (action.low < action.high).all():
        return f"its actions have no width ({action})"
    if env.spec.max_episode_steps is None:
        return "it has no episode length; give one, such as --episode-length 50"
    named = env.has_wrapper_attr("compute_reward") and env.get_wrapper_attr("compute_reward")
    if not callable(named):
        return "it has no compute_reward(achieved_goal, desired_goal, info)"
    obs, _ = env.reset()
    for key in KEYS:
        if np.shape(obs[key]) != space[key].shape:
            return f"its {key} is {np.shape(obs[key])}, its space says {space[key].shape}"
    try:
        rewards = _three_rewards(env)
    except Exception as error:
        return f"its compute_reward does not take a batch of goals and no info ({_said(error)})"
    if rewards.shape != (3,):
        return f"its compute_reward is not vectorised: 3 pairs of goals gave {rewards.shape}"
    if rewards[0] not in (0, 1) or not np.isin(rewards, (rewards[0] - 1, rewards[0])).all():
        return (
            "its rewards are not the -1 and 0 (reached) of Eq. (1), nor 0 and 1,"
            f" but {rewards[0]:g} for a goal that is reached and {rewards[1]:g} for another"
        )
    return None


def _three_rewards(env: gym.Env) -> np.ndarray:
    """Eq. (1) for a goal that is reached and, twice, for the one that is given after a reset."""
    obs, _ = env.reset()
    achieved = np.stack([obs["achieved_goal"]] * 3)
    desired = np.stack([obs["achieved_goal"], obs["desired_goal"], obs["desired_goal"]])
    return reward_of(env)(achieved, desired)


def examine(name: str, episode_length: int | None = None) -> Task:
    """Make the environment and play an episode of random actions in it, and some more as long as
    the goal has not been reached in any. UsageError, one line, as in `make_env` and for what would
    be learned wrongly without a word: another reward in `step` than `compute_reward` gives for what
    is stored, a goal that moves, an end before the last step that is not a success, goals beyond
    the networks' clip of ±200."""
    env = make_env(name, episode_length)
    try:
        problem = _what_is_wrong(env)
    except Exception as error:
        problem = f"its reset, step or compute_reward raised {_said(error)}"
    finally:
        env.close()
    if problem:
        raise UsageError(f"cannot learn in the environment {name}: {problem}")
    space = env.observation_space
    return Task(
        name=name,
        made=_describe(name, env),
        horizon=env.spec.max_episode_steps,
        obs_dim=space["observation"].shape[0],
        goal_dim=space["desired_goal"].shape[0],
        action_dim=env.action_space.shape[0],
        dt=getattr(env.unwrapped, "dt", 1.0),
        reward_fn=reward_of(env),
    )


def _what_is_wrong(env: gym.Env) -> str | None:
    horizon, rng, reached = env.spec.max_episode_steps, np.random.default_rng(0), False
    for episode, t in itertools.product(range(MOST_LOOKED_AT), range(1, horizon + 1)):
        if t == 1:
            if reached:
                break
            goal = env.reset(seed=episode)[0]["desired_goal"].copy()
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        obs, reward, terminated, truncated, info = env.step(action)
        reached = reached or reward == 0
        problem = disagreement(env, t, goal, obs, reward, np.float32)  # as B_o stores them
        problem = problem or how_it_ended(
            t, horizon, terminated, truncated, succeeded(reward, info)
        )
        if problem:
            return problem
        if np.abs([goal, obs["achieved_goal"]]).max() > CLIP:
            return f"its goals lie beyond ±{CLIP}, all the same to the networks: use other units"
    return None


def disagreement(env: gym.Env, t: int, goal, obs: dict, reward: float, dtype=None) -> str | None:
    """How step t differs from what replay will make of it: the goal of the first observation is not
    `goal` any more, or compute_reward does not give the step's reward. None if all is well."""
    if not np.array_equal(obs["desired_goal"], goal):
        return f"its goal moved in step {t}; it must stand still for an episode"
    if _pen(env):
        return None
    pairs = (np.asarray([x, x], dtype) for x in (obs["achieved_goal"], goal))
    again = reward_of(env)(*pairs)[0]
    if again == reward:
        return None
    return (
        f"step {t} gave the reward {reward + 0:g}, and compute_reward of what it observed gives"
        f" {again + 0:g} (a wrapper that changes either needs a compute_reward of its own)"
    )


def _pen(env: gym.Env) -> bool:
    """Whether it is a Pen task, whose compute_reward gives something else for a batch than for a
    pair, in gymnasium-robotics as in the gym of the paper (NOTES.md, "The Pen tasks' reward")."""
    return getattr(env.unwrapped, "ignore_z_target_rotation", False)


def succeeded(reward: float, info: dict) -> bool:
    """Whether the goal is reached: the environment's own word or, without one, Eq. (1)'s 0."""
    return bool(info.get("is_success", reward == 0))


def how_it_ended(t: int, horizon: int, terminated, truncated, success: bool) -> str | None:
    """Why an episode cannot go on after step t, or None if it can. One that ends because its goal
    is reached is played on to step T, like all others."""
    if t == horizon or not (truncated or (terminated and not success)):
        return None
    if truncated:
        return f"it cut an episode off after {t} of {horizon} steps; try --episode-length {t}"
    return (
        f"an episode ended in step {t} of {horizon} without success; episodes here have one length"
    )


def _describe(name: str, env: gym.Env) -> str:
    name = MISSPELT.get(name, name)
    made, steps = PAPER_ENVS.get(name, name), f"{env.spec.max_episode_steps} steps an episode"
    if isinstance(env, MinusOne):
        steps += "; its rewards of 0 and 1 count as -1 and 0"
    if _pen(env):
        steps += "; what it rewards in replay is not quite what it tests: NOTES.md"
    if name not in PAPER_ENVS:
        return f"{name}: {steps}"
    if made.startswith("PointMass"):
        return f"{name}: our NumPy version, {steps}"
    return f"{name}: {made} of today, MuJoCo {mujoco.__version__}, {steps}"
