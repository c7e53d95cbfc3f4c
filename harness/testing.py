"""What the tests share: small runs, environments with one thing changed, a run in a process."""

import copy
import itertools
import math
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, defaultdict
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch

import run
from ensemble import EnsembleDDPG, Normalizer
from harness import assemble, cli, settings
from harness.records import read_checkpoint, read_rows
from her import EpisodeBuffer
from run import Config, train
from vcp import HERBuffer

HERE = Path(__file__).parent.parent
# Two wait for each other, for most of the time where cores are shared.
torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))

COLUMNS = [*read_rows(HERE / "results/FetchPickAndPlace-v1/vcp/seed0")[0]]  # of progress.csv

SMALL_TRAINING = {"epochs": 1, "cycles": 2, "updates": 2, "batch_size": 32, "eval_episodes": 16}
SMALL = {"env": "PointMassEmptyEnv-v1", "cycles": 2, "updates": 2, "batch_size": 16}
SMALL |= {"heads": 2, "eval_episodes": 16, "num_workers": 1}
ARGUMENTS = [f"{settings.flag(k)}={v}" for k, v in SMALL.items()]


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


def assert_drawn_as_in_her(batch, n, horizon, ratio):
    """Of n `numbered_episodes` all steps are drawn alike, with the goal of a later step, all alike,
    or, with a probability of 1 - ratio, with the goal of the episode; and `assert_whole`."""
    expected = {}
    for e, t in itertools.product(range(n), range(horizon)):
        expected[e, t, -1 - e, -1 - e] = (1 - ratio) / (n * horizon)
        for later in range(t + 1, horizon + 1):
            expected[e, t, e, later] = ratio / (horizon - t) / (n * horizon)
    step = batch["obs"] / 10
    counts = Counter(map(tuple, np.hstack([step, batch["goal"]]).astype(int).tolist()))
    assert counts.keys() <= expected.keys()
    assert_frequencies([counts[key] for key in expected], [*expected.values()])
    assert_whole(batch)


def assert_whole(batch):
    """What belongs to a transition of `numbered_episodes` is of the same episode and step, and the
    reward is 0 where the goal is the NEXT achieved goal."""
    np.testing.assert_array_equal(batch["action"], -batch["obs"] / 10)
    np.testing.assert_array_equal(batch["next_obs"] - batch["obs"], [[0, 10]] * len(batch["obs"]))
    np.testing.assert_array_equal(batch["hindsight"], batch["goal"][:, 0] >= 0)
    reached = (batch["next_obs"] == 10 * batch["goal"]).all(axis=1)
    np.testing.assert_array_equal(batch["reward"], reached - 1.0)


def random_agent(num_heads=16, seed=0, obs_dim=5, goal_dim=3, action_dim=2, **kwargs):
    """An agent with biases other than 0, targets unlike the networks, and statistics."""
    sizes = (obs_dim, goal_dim, action_dim)
    agent = EnsembleDDPG(*sizes, gamma=0.9, num_heads=num_heads, seed=seed, **kwargs)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for net in (agent.actor, agent.critic, agent.target_actor, agent.target_critic):
            for p in (*net.trunk, *net.stacks):
                p.add_(0.05 * torch.randn(p.shape, generator=generator))
    rng = np.random.default_rng(seed)
    agent.normalizer.update(rng.normal(1, 2, (500, obs_dim + goal_dim)))
    return agent


SPIED = {  # none of them a default
    "env": "PointMassEmptyEnv-v1",
    "seed": 5,
    "epochs": 1,
    "cycles": 3,
    "updates": 2,
    "batch_size": 24,
    "episode_length": 20,
    "buffer_size": 700,
    "relabel_ratio": 0.6,
    "learning_rate": 2e-3,
    "heads_at_once": 2,
    "polyak": 0.9,
    "noise": 0.11,
    "random_actions": 0.22,
    "action_penalty": 0.33,
    "eval_episodes": 40,
    "heads": 4,
    "temperature": 3.0,
    "importance": "inverse",
    "scored_per_drawn": 1.5,
    "her_buffer_capacity": 650,
    "priority": "variance",
    "acting_head": "one",
    "num_workers": 1,
}

SPIES = {
    "agent": (assemble, "EnsembleDDPG"),
    "B_o": (assemble, "EpisodeBuffer"),
    "B_h": (assemble, "HERBuffer"),
    "explore": (run, "exploration"),
    "act": (EnsembleDDPG, "act"),
    "rollout": (run, "rollout"),
    "to B_o": (EpisodeBuffer, "add"),
    "relabel": (run, "relabel_future"),
    "normalise": (Normalizer, "update"),
    "snapshot": (EnsembleDDPG, "snapshot_q_variance"),
    "fill B_h": (run, "update_her_buffer"),
    "score": (run, "score"),
    "draw": (HERBuffer, "sample"),
    "update": (EnsembleDDPG, "update_heads"),
    "to B_h": (HERBuffer, "add"),
    "priorities": (HERBuffer, "update_priorities"),
    "targets": (EnsembleDDPG, "update_targets"),
    "value": (EnsembleDDPG, "value"),
}


@cache
def spied_run(**changes):
    """A run with SPIED and these changes: `row`; `calls`, a list for each of SPIES; `order`, the
    names of those that the main thread has made. Scoring waits until the last head has moved."""
    calls, order, moved = defaultdict(list), [], threading.Event()

    def spy(key, owner, name):
        function = getattr(owner, name)

        def noted(*args, **kwargs):
            agent_then = copy.deepcopy(args[0]) if key == "snapshot" else None
            if key == "score":
                assert moved.wait(timeout=60)
                moved.clear()
            result = function(*args, **kwargs)
            if key == "rollout":  # a run this short reaches no goal: one in the second, and so on
                result = result[0], np.arange(16) < len(calls[key])
            if key == "update" and 3 in args[1]:
                moved.set()
            thread = threading.current_thread()
            if thread is threading.main_thread():
                order.append(key)
            call = {"args": args, "kwargs": kwargs, "result": result}
            calls[key].append(SimpleNamespace(**call, thread=thread, agent_then=agent_then))
            return result

        patch.setattr(owner, name, noted)

    with pytest.MonkeyPatch.context() as patch, TemporaryDirectory() as folder:
        for key, place in SPIES.items():
            spy(key, *place)
        (row,) = train(Config(**{**SPIED, **changes}, out=f"{folder}/run"))
    return SimpleNamespace(row=row, calls=calls, order=order)


class Line(gym.Env):
    """A point on a line, with nothing wrong. A test overrides one of these methods or attributes:
    what is observed, how rewards come out, what `step` returns. `unseeded` counts resets
    without a seed: 1 where it is looked at, more in training."""

    tolerance, best, unit = 0.1, 0.0, 1  # the unit of what is observed
    resets = unseeded = 0
    space = gym.spaces.Box(-2, 2, (1,), np.float64)
    observation_space = gym.spaces.Dict(observation=space, achieved_goal=space, desired_goal=space)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def observe(self):
        x, g = self.unit * self.x, self.unit * self.g
        return {"observation": x, "achieved_goal": x, "desired_goal": g}

    def rewarded(self, rewards):
        return rewards

    def stepped(self, obs, reward, terminated, truncated, info):
        return obs, reward, terminated, truncated, info

    def compute_reward(self, achieved_goal, desired_goal, info):
        far = np.abs(achieved_goal - desired_goal)[..., 0] > self.tolerance * self.unit
        return self.rewarded(self.best - far.astype(np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.resets = 0, self.resets + 1
        self.unseeded += seed is None
        self.x, self.g = self.np_random.uniform(-1, 1, (2, 1))
        return self.observe(), {}

    def step(self, action):
        self.t += 1
        self.x = np.clip(self.x + 0.2 * action, -1, 1)
        obs = self.observe()
        reward = self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {})
        return self.stepped(obs, reward, False, False, {"is_success": bool(reward == self.best)})


def without_timing(folder):
    rows = read_rows(folder)
    return [{k: v for k, v in row.items() if not k.endswith("_seconds")} for row in rows]


def assert_same_run(a, b):
    """The same rows and the same learned state, timing aside."""

    def leaves(state):
        if isinstance(state, dict):
            return leaves([*state.values()])
        if isinstance(state, (list, tuple)):
            return [leaf for part in state for leaf in leaves(part)]
        return [state]

    assert without_timing(a) == without_timing(b)
    first, second = (leaves(read_checkpoint(f / "checkpoint.pt")["state"]) for f in (a, b))
    assert len(first) == len(second) > 100
    for x, y in zip(first, second, strict=True):
        assert torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y


def start(*arguments, program=None, module=None, script=HERE / "run.py", limit=None, cwd=None):
    """run.py (or a program's text, a module or a script) in a process and session of its own,
    which Ctrl-C reaches even if these tests run in the background; with a limit on the size of the
    files it may write; in this folder or another."""

    def prepare():
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        if limit:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    what = ["-c", program] if program else ["-m", module] if module else [script]
    return subprocess.Popen(
        [sys.executable, *map(str, [*what, *arguments])],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(HERE), "OMP_NUM_THREADS": "1"},
        preexec_fn=prepare,
        cwd=cwd,
    )


def wait_for_an_epoch(process, folder):
    """Until the first is whole, with curve.png: an import such as matplotlib's may lose
    what a signal raises, or make an ImportError of it."""
    while not (folder / "curve.png").exists() and process.poll() is None:
        time.sleep(0.05)


def finish(process):
    """Exit code, stdout and stderr."""
    out, err = process.communicate(timeout=600)
    return process.returncode, out, err


def command(*arguments, cwd):
    """The command line, in a process of its own: exit code, stdout, stderr."""
    return finish(start(*arguments, cwd=cwd))


def main(argv):
    """The command line, in this process."""
    cli.main(train, argv)
