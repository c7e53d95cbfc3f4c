"""Environments side by side: gymnasium's vector environments, several to a worker process.

With a process for each environment, every step of each costs a message and a wake-up; with 16
environments on two cores these take a third of the time. So a worker holds a group of environments.
The workers form two halves, of which one steps while the networks act for the other.
"""

import os
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from multiprocessing import connection
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from harness.border import KEYS, Border
from harness.errors import UsageError
from harness.tasks import PAPER_ENVS, make_env

MakeEnv = Callable[[], Border]


def available_cores() -> list[int]:
    """The processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count()))


def read_joints_by_index(env: Border) -> Border:
    """Make a Fetch or Hand environment find its joints once. gymnasium-robotics looks each of them
    up by name at each step, a quarter to almost half of the step's time; the values are the same.
    Other environments are left as they are."""
    robot = env.unwrapped
    names = getattr(getattr(robot, "_model_names", None), "joint_names", ())
    joints = [robot.model.joint(name) for name in names if name.startswith("robot")]
    if joints and hasattr(getattr(robot, "_utils", None), "robot_get_obs"):
        positions = np.concatenate([joint.qposadr for joint in joints])
        velocities = np.concatenate([joint.dofadr for joint in joints])

        def robot_get_obs(model, data, joint_names):
            return data.qpos[positions], data.qvel[velocities]

        robot._utils = SimpleNamespace(**{**vars(robot._utils), "robot_get_obs": robot_get_obs})
    return env


class EnvGroup(gym.Env):
    """Several environments as one: its observations and actions have a first axis over them.

    Nothing is reset by itself: episodes have a fixed length, and one that ends with success is
    played on. EnvironmentFailed as in `Border`.

    main: the main process's id, for a group that lives in another, which ignores Ctrl-C.
    """

    def __init__(self, make: MakeEnv, size: int, main: int | None = None):
        # AsyncVectorEnv makes one of these in the main process too, to look at its spaces.
        for_its_spaces = os.getpid() == main
        if main and not for_its_spaces:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)  # whose handler is the main process's
            if hasattr(signal, "SIGHUP"):
                signal.signal(signal.SIGHUP, signal.SIG_IGN)
        try:
            self.envs = [read_joints_by_index(make()) for _ in range(1 if for_its_spaces else size)]
        except UsageError as error:  # only this one cannot be made: a port, a licence
            if not main or for_its_spaces:
                raise
            print(f"run.py: {error}", file=sys.stderr, flush=True)
            os._exit(2)
        spaces = self.envs[0].observation_space
        self.observation_space = gym.spaces.Dict(
            {k: gym.spaces.Box(-np.inf, np.inf, (size, *spaces[k].shape), np.float32) for k in KEYS}
        )
        actions = self.envs[0].action_space.shape
        self.action_space = gym.spaces.Box(-1, 1, (size, *actions), np.float32)

    def reset(self, *, seed=None, options=None):
        seeds = [None if seed is None else seed + i for i in range(len(self.envs))]
        pairs = zip(self.envs, seeds, strict=True)
        obs = self._stack([env.reset(seed=s)[0] for env, s in pairs])
        return obs, {"is_success": np.zeros(len(self.envs), bool)}

    def step(self, action):
        stepped = [env.step(a) for env, a in zip(self.envs, action, strict=True)]
        success = np.array([info["is_success"] for *_, info in stepped])
        return self._stack([obs for obs, *_ in stepped]), 0.0, False, False, {"is_success": success}

    def close(self):
        for env in self.envs:
            env.close()

    def _stack(self, observations):
        return {k: np.stack([obs[k] for obs in observations]) for k in KEYS}


class Here(SyncVectorEnv):
    """Environments in this process, asked as an AsyncVectorEnv is: `..._async` does the work."""

    processes = ()

    def reset_async(self, seed=None):
        self._answer = self.reset(seed=seed)

    def step_async(self, action):
        self._answer = self.step(action)

    def reset_wait(self):
        return self._answer

    step_wait = reset_wait


class Half:
    """Half of the environments or, without halves, all: those of the slice `which`, shared evenly
    by processes or, with `here`, in this one. `reset` and `step` begin and `wait` waits, so that
    meanwhile the networks act for the other half."""

    def __init__(self, name: str, make: MakeEnv, which: slice, num_workers: int, here: bool):
        self.name, self.which, self.size = name, which, (which.stop - which.start) // num_workers
        groups = [partial(EnvGroup, make, self.size, None if here else os.getpid())] * num_workers
        vector = Here if here else AsyncVectorEnv
        try:
            self._env = vector(groups, copy=False, autoreset_mode=AutoresetMode.DISABLED)
        except (EOFError, ConnectionError) as error:
            raise UsageError(f"a worker process of {name} could not be started") from error

    def reset(self, seed: int | None = None) -> None:
        """Start an episode in each. With a seed, environment i of all is seeded with seed + i;
        without, it goes on with the random numbers it has."""
        first = range(self.which.start, self.which.stop, self.size)
        seeds = None if seed is None else [seed + i for i in first]
        self._finish = self._env.reset_wait
        self._ask(self._env.reset_async, seed=seeds)

    def step(self, action: np.ndarray) -> None:
        """One step in each: actions (n, A) in [-1, 1]."""
        self._finish = self._env.step_wait
        self._ask(self._env.step_async, action.reshape(-1, self.size, action.shape[-1]))

    def wait(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Observations, float32 arrays of (n, ...) that hold until the next step, and is_success
        (n,), False after `reset`."""
        obs, *_, info = self._ask(self._finish)
        obs = {name: x.reshape(-1, x.shape[-1]) for name, x in obs.items()}
        return obs, info["is_success"].reshape(-1)

    def close(self, now: bool) -> None:
        """End the processes. now: in whatever step they are, of whose answer a part may have been
        read already."""
        with suppress(EOFError, ConnectionError):  # of a process that is dead already
            if not (now and self._env.processes):
                self._env.close()
        for process in self._env.processes:  # those that have not ended
            process.terminate()
            process.join()
        self._env.closed = True

    def _ask(self, method, *args, **kwargs):
        """Call it, and if a process is found dead say how it ended."""
        try:
            return method(*args, **kwargs)
        except (EOFError, ConnectionError) as error:
            ended = connection.wait([p.sentinel for p in self._env.processes], timeout=1)
            dead = [p for p in self._env.processes if p.sentinel in ended]
            for process in dead:
                process.join()
            codes = ", ".join(str(process.exitcode) for process in dead) or "unknown"
            raise ChildProcessError(
                f"a worker process of {self.name} died (exit code {codes})"
            ) from error


class ParallelEnvs:
    """num_envs environments of `make_env(name, **settings)` in num_workers processes, the same
    number in each; use it in a `with`. With one worker there is no other process.

    in_halves: the workers, an even number, form two halves. While one half's environments step, the
    networks act for the other's.
    """

    def __init__(
        self, name: str, num_envs: int, num_workers: int, in_halves: bool = False, **settings
    ):
        self.num_envs, self.num_workers = num_envs, num_workers
        parts = 2 if in_halves else 1
        if num_envs % num_workers or num_workers % parts:
            shared = f"{num_envs} environments evenly" + " in two halves" * in_halves
            raise ValueError(f"{num_workers} workers cannot share {shared}")
        # gymnasium would print the traceback of what a worker raises; it is raised here as well.
        self._logged, gym.logger.min_level = gym.logger.min_level, 50
        # A process that is not forked does not know what the user's own script has registered.
        spec = gym.registry.get(PAPER_ENVS.get(name, name).rpartition(":")[2])
        make = partial(make_env, name, spec=spec, **settings)
        envs, workers = num_envs // parts, num_workers // parts
        self.halves: list[Half] = []
        try:
            for i in range(parts):
                which = slice(i * envs, (i + 1) * envs)
                self.halves.append(Half(name, make, which, workers, here=num_workers == 1))
        except BaseException:
            self.close(now=True)
            raise

    def empty_episodes(self, horizon: int) -> dict[str, np.ndarray]:
        """Room for an episode of each environment: the arrays of her.EpisodeBuffer."""
        vector = self.halves[0]._env
        sizes = {key: box.shape[-1] for key, box in vector.single_observation_space.items()}
        shapes = {
            "obs": (horizon + 1, sizes["observation"]),
            "achieved_goal": (horizon + 1, sizes["achieved_goal"]),
            "desired_goal": (sizes["desired_goal"],),
            "action": (horizon, vector.single_action_space.shape[-1]),
        }
        return {name: np.empty((self.num_envs, *s), np.float32) for name, s in shapes.items()}

    def reset(self, seed: int) -> None:
        """Seed environment i with seed + i."""
        for half in self.halves:
            half.reset(seed)
        for half in self.halves:
            half.wait()

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        # After an error a worker may be in the middle of a step, or gone.
        self.close(now=kind is not None)

    def close(self, now: bool = False) -> None:
        """End the environments and their processes; now: in whatever step they are."""
        with ExitStack() as stack:  # all of it, also where one half raises
            stack.callback(setattr, gym.logger, "min_level", self._logged)
            for half in self.halves:
                stack.callback(half.close, now)


def number_of_workers(asked: int | None, num_envs: int) -> int:
    """As many as were asked for or, with None, as there are cores; fewer where the environments
    cannot be shared evenly."""
    most = min(asked or len(available_cores()), num_envs)
    return max(w for w in range(1, most + 1) if num_envs % w == 0)
