"""The tasks: the paper's sixteen names (Appendix A), and any other goal environment."""

import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr
from functools import partial
from importlib.metadata import version

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from harness.border import Border, asked, refuse_spaces, remark, said
from harness.errors import EnvironmentFailed, UsageError

try:
    # they print a notice about other environments
    with redirect_stderr(io.StringIO()):
        import gymnasium_robotics

        import envs_point
except Exception as error:  # of many kinds, if MuJoCo does not find the renderer that it is to take
    if "MUJOCO_GL" not in os.environ:
        raise
    print(f"run.py: MUJOCO_GL={os.environ['MUJOCO_GL']}: {said(error)}", file=sys.stderr)
    sys.exit(2)
gym.register_envs(gymnasium_robotics)
gym.register_envs(envs_point)  # PointMass and SparseReacher

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


MOST_LOOKED_AT = 8  # episodes, by `examine`
CLIP, FLOOR = 200, 0.01  # what the networks can tell apart: see ensemble.Normalizer
MOST_ROWS = 10_000  # steps, of which `examine` looks at the scale


def make_env(
    name: str, episode_length: int | None = None, spec: EnvSpec | None = None, **kwargs
) -> Border:
    """Make a goal environment by the paper's name, by a current id or as module:ID.

    Its episodes have `episode_length` steps or, without one, 50 for the paper's names and their own
    length for all others. Actions are rescaled to [-1, 1]; rewards of 0 and 1 become -1 and 0.
    spec: what another process has registered by this name. kwargs go to the environment.
    UsageError, one line, for an unknown name, for what raises an error, and for what this method
    cannot learn: no goals, no Box of actions, no vectorised `compute_reward` of -1 and 0, no
    episode length.
    """
    name = MISSPELT.get(name, name)
    length = episode_length or (PAPER_LENGTH if name in PAPER_ENVS else None)
    made = PAPER_ENVS.get(name, name)
    if spec is not None and ":" not in made:
        gym.registry.setdefault(spec.id, spec)
    how = {"max_episode_steps": length, "disable_env_checker": True, **kwargs}
    with before_training():
        try:
            env = asked(name, "creation", gym.make, made, **how)
        except EnvironmentFailed as error:
            module = sys.modules.get(made.rpartition(":")[0])  # which may be one of this project's
            where = f"; the module is {module.__file__}" if module else ""
            raise EnvironmentFailed(f"{error}{where}") from error
        asked(name, "spaces", refuse_spaces, env, name)
        box = env.action_space
        if not (np.all(box.low == -1) and np.all(box.high == 1)):
            # clipped, as rescaling rounds, and some environments look closely
            clip = partial(np.clip, a_min=box.low, a_max=box.high)
            env = gym.wrappers.TransformAction(env, clip, box)
            env = gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
        return Border(env, name)


@contextmanager
def before_training() -> Iterator[None]:
    """What an environment does wrong in the block is bad input; so is what does not fit."""
    try:
        yield
    except EnvironmentFailed as error:
        raise UsageError(f"cannot learn in the environment {error}") from error
    except (MemoryError, OSError) as error:
        raise UsageError(f"the run cannot be set up: {said(error)}") from error


def examine(
    name: str,
    episode_length: int | None = None,
    fits: Callable[[Border], None] = lambda task: None,
) -> Border:
    """Make the environment and play an episode of random actions in it, and some more as long as
    the goal has not been reached in any; `made` says what it is. UsageError, one line, as in
    `make_env`, for all that `Border` finds wrong, and for goals of a scale that the networks do not
    see; single numbers of such a scale are a line on stderr. fits: called before anything is
    played; it may raise too."""
    env = make_env(name, episode_length)
    with ExitStack() as unless_all_is_well, before_training():
        unless_all_is_well.callback(env.close)
        fits(env)
        rows, seeded = _played(env)
        _look_at_the_scale(env, rows)
        unless_all_is_well.pop_all()
    unseeded = "" if seeded else "; it does not follow its seed, so that runs differ"
    env.made = _describe(name, env) + unseeded
    return env


def _played(env: Border) -> tuple[list[dict], bool]:
    """Play the episodes, and compare their rewards with those that replay makes, at once and some
    resets later. Returns their observations, MOST_ROWS at most, and whether the first episode is
    the same when it is played again with its seed."""
    rng, rows, played, reached = np.random.default_rng(0), [], [], False
    for episode in range(MOST_LOOKED_AT):
        obs, _ = env.reset(seed=episode)
        if episode == 0:
            first = [(None, obs)]
        for _ in range(env.horizon):
            action = rng.uniform(-1.2, 1.2, env.action_space.shape).clip(-1, 1).astype(np.float32)
            obs, reward, *_ = env.step(action)
            if episode == 0:
                first.append((action, obs))
            reached = reached or reward == 0
            if len(rows) < MOST_ROWS:
                rows.append(obs)
        env.compare(env.episode, np.float32)  # as B_o stores them
        played.append(env.episode)
        if reached:
            break
    for seed in reversed(range(MOST_LOOKED_AT)):
        obs, _ = env.reset(seed=seed)
    for episode in played:
        env.compare(episode)
    again = [obs, *(env.step(action)[0] for action, _ in first[1:])]  # the first episode
    pairs = zip((obs for _, obs in first), again, strict=True)
    return rows, all(np.array_equal(a[key], b[key]) for a, b in pairs for key in a)


def _look_at_the_scale(env: Border, rows: list[dict]) -> None:
    """EnvironmentFailed for goals that the networks cannot tell apart, a line for such
    numbers. The paper's own tasks, in which some numbers hardly move, are learned."""
    goals = np.array([row[key] for row in rows for key in ("achieved_goal", "desired_goal")])
    hardly_seen = f"beyond ±{CLIP} or by less than {FLOOR}, which the networks hardly see"
    largest = np.abs(goals).max()
    if largest > CLIP or 0 < np.std(goals, axis=0, dtype=np.float64).max() < FLOOR:
        raise env.failed(
            f"its goals move {hardly_seen} (the largest is {largest:.3g}): use other units"
        )
    if env.spec.id in PAPER_ENVS.values():
        return
    obs = np.array([row["observation"] for row in rows])
    for name, x in (("observation", obs), ("goals", goals)):
        seen = np.std(x.clip(-CLIP, CLIP), axis=0, dtype=np.float64)
        hidden = np.flatnonzero((np.ptp(x, axis=0) > 0) & (seen < FLOOR)).tolist()
        if hidden:
            remark(f"{env.name}: numbers {hidden} of its {name} move only {hardly_seen}")


def _describe(name: str, env: Border) -> str:
    name = MISSPELT.get(name, name)
    made, steps = PAPER_ENVS.get(name, name), f"{env.spec.max_episode_steps} steps an episode"
    if env.best == 1:
        steps += "; its rewards of 0 and 1 count as -1 and 0"
    if env.is_pen:
        steps += "; what it rewards in replay is not quite what it tests: NOTES.md"
    if name not in PAPER_ENVS:
        return f"{name}: {steps}"
    if made.startswith("PointMass"):
        return f"{name}: our NumPy version, {steps}"
    return f"{name}: {made} of today, MuJoCo {version('mujoco')}, {steps}"
