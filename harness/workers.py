"""Environments side by side: gymnasium's vector environments, several to a worker process.

One process for each environment pays for a message and a wake-up at every step of each; with 16
environments on two cores that is a third of the time. So a worker holds a group of them.
"""

import os
import signal
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from harness import numerics
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

    main: the main process's id, for a group that lives in another; there Ctrl-C is ignored and, if
    `core` is given, that is the one processor that the process may use.
    """

    def __init__(self, make: MakeEnv, size: int, main: int | None = None, core: int | None = None):
        # AsyncVectorEnv makes one of these in the main process too, to look at its spaces.
        for_its_spaces = os.getpid() == main
        if main and not for_its_spaces:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)  # whose handler is the main process's
            if hasattr(signal, "SIGHUP"):
                signal.signal(signal.SIGHUP, signal.SIG_IGN)
            if core is not None:
                os.sched_setaffinity(0, {core})
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
        return self._stack([env.reset(seed=s)[0] for env, s in pairs]), {}

    def step(self, action):
        stepped = [env.step(a) for env, a in zip(self.envs, action, strict=True)]
        success = np.array([info["is_success"] for *_, info in stepped])
        return self._stack([obs for obs, *_ in stepped]), 0.0, False, False, {"is_success": success}

    def close(self):
        for env in self.envs:
            env.close()

    def _stack(self, observations):
        return {k: np.stack([obs[k] for obs in observations]) for k in KEYS}


class Worker:
    """The environments `which` of all, in a process of their own, or in this one without `main`."""

    def __init__(self, name: str, make: MakeEnv, which: slice, main: int | None, core: int | None):
        self.name, self.which = name, which
        group = partial(EnvGroup, make, which.stop - which.start, main, core)
        vector = AsyncVectorEnv if main else SyncVectorEnv
        try:
            self._env = vector([group], copy=False, autoreset_mode=AutoresetMode.DISABLED)
        except (EOFError, ConnectionError) as error:
            raise UsageError(f"a worker process of {name} could not be started") from error

    def reset(self, seed: int | None = None) -> dict[str, np.ndarray]:
        """Start an episode in each. With a seed, environment i of all is seeded with seed + i;
        without, it goes on with the random numbers it has. Returns float32 arrays of (n, ...)."""
        seed = None if seed is None else [seed + self.which.start]
        return self._copies(self._ask(self._env.reset, seed=seed)[0])

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """One step in each: actions (n, A) in [-1, 1] -> observations, is_success (n,)."""
        obs, *_, info = self._ask(self._env.step, action[None])
        return self._copies(obs), info["is_success"][0]

    def close(self, now: bool) -> None:
        """now: without waiting for a step that may be under way."""
        if now and self._processes():
            # gymnasium would first read the step's answer, and the thread that waits for it has
            # perhaps read half of it
            for process in self._processes():
                process.terminate()
                process.join()
            self._env.closed = True
            return
        try:
            self._env.close()
        except (EOFError, ConnectionError):  # the process is dead, so there is nothing to close
            self._env.closed = True

    def _processes(self):
        return getattr(self._env, "processes", [])

    def _copies(self, obs):
        return {name: x[0].copy() for name, x in obs.items()}

    def _ask(self, method, *args, **kwargs):
        """Call it, and if the process is found dead say how it ended."""
        try:
            return method(*args, **kwargs)
        except (EOFError, ConnectionError) as error:
            (process,) = self._processes()
            process.join(timeout=1)
            raise ChildProcessError(
                f"a worker process of {self.name} died (exit code {process.exitcode})"
            ) from error


class ParallelEnvs:
    """num_envs environments of `make_env(name, **settings)` in num_workers processes, the same
    number in each; use it in a `with`. With one worker there is no other process."""

    def __init__(self, name: str, num_envs: int, num_workers: int, **settings):
        self.num_envs, self.num_workers = num_envs, num_workers
        size, rest = divmod(num_envs, num_workers)
        if rest:
            raise ValueError(f"{num_workers} workers cannot share {num_envs} environments evenly")
        # Left alone, the scheduler wakes workers on the same core while another idles: with a core
        # each, a step of 16 FetchReach takes a fifth less. Fewer workers than cores may share the
        # machine with other runs, and stay free.
        cores = available_cores()
        pin = 1 < num_workers == len(cores) and hasattr(os, "sched_setaffinity")
        self._pool = ThreadPoolExecutor(num_workers, initializer=numerics.begin_thread)
        # gymnasium would print the traceback of what a worker raises; it is raised here as well.
        self._logged, gym.logger.min_level = gym.logger.min_level, 50
        # A process that is not forked does not know what the user's own script has registered.
        spec = gym.registry.get(PAPER_ENVS.get(name, name).rpartition(":")[2])
        self.workers = [
            Worker(
                name,
                partial(make_env, name, spec=spec, **settings),
                slice(i * size, (i + 1) * size),
                main=os.getpid() if num_workers > 1 else None,
                core=cores[i] if pin else None,
            )
            for i in range(num_workers)
        ]

    def each(self, function: Callable[[Worker], object]) -> list:
        """function(worker) for all workers at the same time, each in a thread of its own, so that
        none waits for another: while one acts, the other steps. Returns the results in order."""
        if self.num_workers == 1:
            return [function(self.workers[0])]
        return list(self._pool.map(function, self.workers))

    def reset(self, seed: int) -> None:
        """Seed environment i with seed + i."""
        self.each(lambda worker: worker.reset(seed))

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        # After an error a worker may be in the middle of a step, or gone.
        for worker in self.workers:
            worker.close(now=kind is not None)
        self._pool.shutdown()  # a thread whose environment hung ends with the process
        gym.logger.min_level = self._logged


def whole_heads(num_workers: int | None, num_envs: int, heads: int) -> int:
    """How many workers to take of at most num_workers (None: one a core, and 4 at most), so that
    each has as many environments, those of whole heads or of a part of one."""
    # The main process acts for one worker at a time, so that many wait for it (results/SPEED.md).
    most = min(num_workers or min(len(available_cores()), 4), num_envs)
    return max(
        w for w in range(1, most + 1) if num_envs % w == 0 and (heads % w == 0 or w % heads == 0)
    )
