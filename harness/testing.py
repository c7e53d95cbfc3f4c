"""What the tests share: small runs, environments with one thing changed, a run in a process."""

import math
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

import envs_point
from ensemble import EnsembleDDPG
from harness import cli, settings
from harness.records import TIMING_COLUMNS, read_checkpoint, read_rows
from run import train

HERE = Path(__file__).parent.parent
# Two wait for each other, for most of the time where cores are shared.
torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))


SMALL_TRAINING = {"epochs": 1, "cycles": 2, "updates": 2, "batch_size": 32, "eval_episodes": 16}


def assert_frequencies(counts, probabilities):
    """Chi-square test; the statistic has mean df and variance 2 df, so 5 sigma never fails by
    chance in practice, and a wrong distribution does with the thousands of draws used here."""
    expected = np.asarray(probabilities) * np.sum(counts)
    assert np.all(np.asarray(counts)[expected == 0] == 0)
    counts, expected = np.asarray(counts)[expected > 0], expected[expected > 0]
    statistic, df = np.sum((counts - expected) ** 2 / expected), len(counts) - 1
    assert abs(statistic - df) < 5 * math.sqrt(2 * df) + 5, (statistic, df)


def numbered_episodes(n=4, horizon=50, goal_dim=2):
    """Episodes in which every achieved goal says which episode and step it is of, (e, t), and every
    desired goal which episode, (-1 - e, -1 - e, ...)."""
    e, t = np.meshgrid(np.arange(n), np.arange(horizon + 1), indexing="ij")
    achieved = np.stack([e, t], axis=-1).astype(np.float32)
    return {
        "obs": achieved * 10,
        "achieved_goal": achieved,
        "desired_goal": np.repeat(-1 - np.arange(n, dtype=np.float32)[:, None], goal_dim, axis=1),
        "action": -achieved[:, :-1],
    }


def exact_reward(achieved, desired):
    return np.where((achieved == desired).all(axis=-1), 0.0, -1.0)


def random_agent(num_heads=16, seed=0, obs_dim=5, goal_dim=3, action_dim=2, **kwargs):
    """An agent with biases other than 0, targets unlike the networks, and statistics."""
    agent = EnsembleDDPG(
        obs_dim, goal_dim, action_dim, gamma=0.9, num_heads=num_heads, seed=seed, **kwargs
    )
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for net in (agent.actor, agent.critic, agent.target_actor, agent.target_critic):
            for p in (*net.trunk, *net.stacks):
                p.add_(0.05 * torch.randn(p.shape, generator=generator))
    rng = np.random.default_rng(seed)
    agent.normalizer.update(rng.normal(1, 2, (500, obs_dim + goal_dim)))
    return agent


class Tracker(gym.Env):
    """A goal environment from outside this project: 3 numbers, 1 of them the goal, 2 actions with
    bounds of their own, 7 steps an episode."""

    observation_space = envs_point.goal_space(3, 1)
    action_space = gym.spaces.Box(np.float32([0, -5]), np.float32([10, 5]))

    def compute_reward(self, achieved_goal, desired_goal, info):
        return envs_point.sparse_reward(achieved_goal, desired_goal, 0.5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.goal = self.np_random.uniform(-2, 2, (2, 1))
        self.last = np.zeros(2)
        return self._observe(), {}

    def step(self, action):
        assert self.action_space.contains(np.float32(action)), action
        self.last, self.x = action, self.x + 0.1 * (action[0] - 5) + 0.1 * action[1]
        obs = self._observe()
        reward = self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {})
        return obs, float(reward), False, False, {}

    def _observe(self):
        observation = np.concatenate([self.x, self.last])
        return {
            "observation": observation,
            "achieved_goal": self.x.copy(),
            "desired_goal": self.goal.copy(),
        }


class Line(gym.Env):
    """A point on a line, with nothing wrong: many tests change one thing each."""

    tolerance, best, unit = 0.1, 0.0, 1  # the unit of what is observed
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode=None):
        box = gym.spaces.Box(-2 * self.unit, 2 * self.unit, (1,), np.float64)
        self.observation_space = gym.spaces.Dict(
            observation=box, achieved_goal=box, desired_goal=box
        )

    def compute_reward(self, achieved_goal, desired_goal, info):
        far = np.abs(achieved_goal - desired_goal)[..., 0] > self.tolerance * self.unit
        return self.best - far.astype(np.float32)

    def observe(self):
        x, g = self.unit * self.x, self.unit * self.g
        return {"observation": x, "achieved_goal": x, "desired_goal": g}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        self.x, self.g = self.np_random.uniform(-1, 1, (2, 1))
        return self.observe(), {}

    def step(self, action):
        self.t += 1
        self.x = np.clip(self.x + 0.2 * action, -1, 1)
        obs = self.observe()
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {}))
        return obs, reward, False, False, {"is_success": reward == self.best}


class Broken(envs_point.PointMass):
    """Gives a NaN at step 7 of an episode without a seed of its own, as those are that train."""

    def reset(self, *, seed=None, options=None):
        self.left = 7 if seed is None else -1
        return super().reset(seed=seed, options=options)

    def step(self, action):
        self.left -= 1
        obs, *rest = super().step(action)
        if self.left == 0:
            obs["observation"][1] = math.nan
        return obs, *rest


class BrokenReward(envs_point.PointMass):
    """Gives a NaN for goals far to the right, but not in an episode with a seed of its own."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        reward = super().compute_reward(achieved_goal, desired_goal, info)
        return np.where(self.late & (np.asarray(achieved_goal)[..., 0] > 0.54), np.nan, reward)

    def reset(self, *, seed=None, options=None):
        self.late = seed is None
        super().reset(seed=seed)
        self._xy = self._goal = (0.3, 0.0)
        return self._observe(), {}


gym.register("Tracker-v0", Tracker, max_episode_steps=7)
gym.register("Broken-v0", Broken, max_episode_steps=10)
gym.register("BrokenReward-v0", BrokenReward, max_episode_steps=50)


def without_timing(folder):
    rows = read_rows(folder)
    return [{k: v for k, v in row.items() if k not in TIMING_COLUMNS} for row in rows]


SMALL = {
    "env": "PointMassEmptyEnv-v1",
    "cycles": 2,
    "updates": 2,
    "batch_size": 16,
    "heads": 2,
    "eval_episodes": 16,
    "num_workers": 1,
}


ARGUMENTS = [f"{settings.flag(k)}={v}" for k, v in SMALL.items()]


def start(*arguments, program=None, module=None, script=None, limit=None, cwd=None):
    """run.py (or a program's text, a module or a script) in a process and session of its own,
    which Ctrl-C reaches even if these tests run in the background; with a limit on the size of the
    files it may write; in this folder or another."""

    def prepare():
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        if limit:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    what = (
        ["-c", program]
        if program
        else ["-m", module]
        if module
        else [str(script or HERE / "run.py")]
    )
    return subprocess.Popen(
        [sys.executable, *what, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(HERE), "OMP_NUM_THREADS": "1"},
        preexec_fn=prepare,
        cwd=cwd,
    )


def wait_for_an_epoch(process, folder):
    """Until the first is whole, its picture too: what a signal raises in an import, as that of
    matplotlib, its C code may turn into an ImportError or lose."""
    while not (folder / "curve.png").exists() and process.poll() is None:
        time.sleep(0.05)


def finish(process):
    """Exit code, stdout and stderr."""
    out, err = process.communicate(timeout=600)
    return process.returncode, out, err


def tensors(state):
    """All tensors and numbers of a checkpoint, in order."""
    if isinstance(state, dict):
        state = list(state.values())
    if isinstance(state, (list, tuple)):
        return [t for part in state for t in tensors(part)]
    return [state]


def assert_same_run(a, b):
    """The same rows and the same learned state, timing aside."""
    rows = [
        [{k: v for k, v in row.items() if k not in TIMING_COLUMNS} for row in read_rows(folder)]
        for folder in (a, b)
    ]
    assert rows[0] == rows[1]
    first, second = (
        tensors(read_checkpoint(folder / "checkpoint.pt")["parts"]) for folder in (a, b)
    )
    assert len(first) == len(second) > 100
    for x, y in zip(first, second, strict=True):
        assert torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y


def command(*arguments, cwd):
    """The command line, in a process of its own: exit code, stdout, stderr."""
    program = [sys.executable, str(HERE / "run.py"), *arguments]
    done = subprocess.run(program, capture_output=True, text=True, cwd=cwd)
    return done.returncode, done.stdout, done.stderr


def main(argv):
    """The command line, in this process."""
    cli.main(train, argv)
