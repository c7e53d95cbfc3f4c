"""Environments side by side: gymnasium's vector environments, several to a worker process.

One process for each environment pays for a message and a wake-up at every step of each; with 16
environments on two cores that is a third of the time. So a worker holds a group of them.
"""

import os
import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space

from envs_point import UsageError, make_env


def available_cores() -> list[int]:
    """The processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count()))


@contextmanager
def one_thread():
    """Run the block's PyTorch calls on one thread each. Products of this size gain little from
    more, and where a core is busy with something else, threads that meet after each product wait
    for it every time: on a busy machine a run with two was a hundred times slower."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def small_calls():
    """Run the block without `fast_products`: acting is too little work for it."""
    products = torch.backends.mkldnn.matmul
    precision = products.fp32_precision
    products.fp32_precision = "ieee"
    try:
        yield
    finally:
        products.fp32_precision = precision


def products_are_rounded() -> bool:
    """Whether a product of float32 matrices loses digits that float32 has and bfloat16 has not."""
    x = torch.full((256, 256), 1 + 2**-12)
    return not torch.equal(x @ torch.eye(256), x)


@contextmanager
def fast_products():
    """Multiply matrices with oneDNN in the block, where PyTorch by itself takes MKL, which leaves
    half the width of an AMD processor's vectors unused. PyTorch asks oneDNN if rounding to bfloat16
    is allowed; only processors with a unit for that (AMX) then do round, and for them MKL stays."""
    products = torch.backends.mkldnn.matmul
    before = products.fp32_precision
    products.fp32_precision = "bf16"
    if products_are_rounded():
        products.fp32_precision = before
    try:
        yield
    finally:
        products.fp32_precision = before


@contextmanager
def without_denormals():
    """Take numbers below 1.2e-38 for 0 in the block. Adam's moments of a unit that has stopped
    firing decay to such "denormal" numbers and stay there, and an Intel processor takes 35 times as
    long for each. A thread has this from the one that starts it, so enter before PyTorch has
    started its own."""
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def read_joints_by_index(env: gym.Env) -> gym.Env:
    """Make a Fetch or Hand environment find its joints once. gymnasium-robotics looks each of them
    up by name at each step, a quarter to almost half of the step's time; the values are the same.
    Other environments are left as they are."""
    robot = env.unwrapped
    if hasattr(robot, "_model_names"):
        names = [name for name in robot._model_names.joint_names if name.startswith("robot")]
        joints = [robot.model.joint(name) for name in names]
        positions = np.concatenate([joint.qposadr for joint in joints])
        velocities = np.concatenate([joint.dofadr for joint in joints])

        def robot_get_obs(model, data, joint_names):
            return data.qpos[positions], data.qvel[velocities]

        robot._utils = SimpleNamespace(**{**vars(robot._utils), "robot_get_obs": robot_get_obs})
    return env


class EnvGroup(gym.Env):
    """Several environments as one: its observations and actions have a first axis over them.

    "is_success" of the step's info is the environment's own or, without one, Eq. (1)'s reward of 0.
    Nothing is reset by itself: episodes have a fixed length. `terminated`: if any has ended early.

    main: the main process's id, for a group that lives in another; there Ctrl-C is ignored and, if
    `core` is given, that is the one processor that the process may use.
    """

    def __init__(self, name: str, size: int, main: int | None = None, core: int | None = None):
        # AsyncVectorEnv makes one of these in the main process too, to look at its spaces.
        for_its_spaces = os.getpid() == main
        if main and not for_its_spaces:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            if core is not None:
                os.sched_setaffinity(0, {core})

        def make():
            return read_joints_by_index(make_env(name))

        made = 1 if for_its_spaces else size
        self.envs = SyncVectorEnv([make] * made, copy=False, autoreset_mode=AutoresetMode.DISABLED)
        self.observation_space = batch_space(self.envs.single_observation_space, size)
        self.action_space = batch_space(self.envs.single_action_space, size)

    def reset(self, *, seed=None, options=None):
        return self.envs.reset(seed=seed)[0], {}

    def step(self, action):
        obs, reward, terminated, _, info = self.envs.step(action)
        success = np.asarray(info.get("is_success", reward == 0), dtype=bool)
        return obs, 0.0, bool(terminated.any()), False, {"is_success": success}

    def close(self):
        self.envs.close()


class Worker:
    """The environments `rows` of all, in a process of their own, or in this one without `main`."""

    def __init__(self, name: str, rows: slice, main: int | None = None, core: int | None = None):
        self.name, self.rows, self.main = name, rows, main
        group = partial(EnvGroup, name, rows.stop - rows.start, main, core)
        vector = AsyncVectorEnv if main else SyncVectorEnv
        self._env = vector([group], copy=False, autoreset_mode=AutoresetMode.DISABLED)

    def reset(self, seed: int | None = None) -> dict[str, np.ndarray]:
        """Start an episode in each. With a seed, environment i of all is seeded with seed + i;
        without, it goes on with the random numbers it has. Gives float32 arrays of (n, ...)."""
        seed = None if seed is None else [seed + self.rows.start]
        return self._rows(self._ask(self._env.reset, seed=seed)[0])

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """One step in each: actions (n, A) in [-1, 1] -> observations, is_success (n,).
        UsageError if an environment ends its episode."""
        obs, _, terminated, _, info = self._ask(self._env.step, action[None])
        if terminated.any():
            raise UsageError(f"{self.name} ended an episode early: HER here needs a fixed length")
        return self._rows(obs), info["is_success"][0]

    def close(self, now: bool) -> None:
        """now: without waiting for a step that may be under way."""
        try:
            self._env.close(**({"terminate": now} if self.main else {}))
        except (EOFError, ConnectionError):  # the process is dead, so there is nothing to close
            self._env.closed = True

    def _rows(self, obs):
        return {name: x[0].astype(np.float32) for name, x in obs.items()}

    def _ask(self, method, *args, **kwargs):
        """Call it, and if the process is found dead say which environment's and how it ended."""
        try:
            return method(*args, **kwargs)
        except (EOFError, ConnectionError) as error:
            (process,) = self._env.processes
            process.join(timeout=1)
            raise ChildProcessError(
                f"a worker process of {self.name} died (exit code {process.exitcode})"
            ) from error


class ParallelEnvs:
    """num_envs environments in worker processes; use it in a `with`.

    num_workers: None for one a core. It is lowered until each holds the same number of environments
    and, where they are shared out among `heads`, those of whole heads or of a part of one. With 1
    there is no other process.
    """

    def __init__(self, name: str, num_envs: int, num_workers: int | None = None, heads: int = 1):
        cores = available_cores()
        most = min(num_workers or len(cores), num_envs)
        self.num_workers = max(
            w
            for w in range(1, most + 1)
            if num_envs % w == 0 and (heads % w == 0 or w % heads == 0)
        )
        self.num_envs, size = num_envs, num_envs // self.num_workers
        # Left alone, the scheduler wakes workers on the same core while another idles: with a core
        # each, a step of 16 FetchReach takes a fifth less. Fewer workers than cores may share the
        # machine with other runs, and stay free.
        pin = 1 < self.num_workers == len(cores) and hasattr(os, "sched_setaffinity")
        self.workers = [
            Worker(
                name,
                slice(i * size, (i + 1) * size),
                main=os.getpid() if self.num_workers > 1 else None,
                core=cores[i] if pin else None,
            )
            for i in range(self.num_workers)
        ]

    def each(self, function: Callable[[Worker], object]) -> list:
        """function(worker) for all workers at the same time, each in a thread of its own, so that
        none waits for another: while one acts, the other steps. Gives the results in order."""
        with ThreadPoolExecutor(self.num_workers) as pool:
            return list(pool.map(function, self.workers))

    def reset(self, seed: int) -> None:
        """Seed environment i with seed + i."""
        self.each(lambda worker: worker.reset(seed))

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        # After an error a worker may be in the middle of a step, or gone.
        for worker in self.workers:
            worker.close(now=kind is not None)
