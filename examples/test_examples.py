"""Tests of the examples: they run where nothing else of this project is, and they learn."""

import importlib
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import own_task
import pytest

HERE = Path(__file__).parent
MODULES = ("vcp", "her", "ensemble")


def run_alone(folder: Path, example: str, *arguments: str) -> str:
    """What an example prints in a folder with the three modules."""
    for file in [HERE / example, *(HERE.parent / f"{name}.py" for name in MODULES)]:
        shutil.copy(file, folder)
    command = [sys.executable, example, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_own_task_is_learned_in_an_empty_folder(tmp_path):
    printed = run_alone(tmp_path, "own_task.py")
    rates = [float(rate) for rate in re.findall(r"success ([\d.]+)", printed)]
    assert len(rates) == 4 and rates[-1] >= 0.95, printed


class WallRoom(own_task.Room):
    """A second task: a wall, |x| < 0.1 and y > 0, along which the points slide."""

    def reset(self, seed=None):
        super().reset(seed)
        for places in (self.xy, self.goal):  # beside the wall
            places[:, 0] = np.sign(places[:, 0]) * (0.1 + 0.9 * abs(places[:, 0]))
        return self.observe(), {}

    def step(self, action):
        x, y = self.xy.T
        super().step(action)
        inside = (abs(self.xy[:, 0]) < 0.1) & (self.xy[:, 1] > 0)
        beside = abs(x) >= 0.1
        self.xy[inside & beside, 0] = x[inside & beside]
        self.xy[inside & ~beside, 1] = y[inside & ~beside]
        return self.observe(), own_task.reward_fn(self.xy, self.goal), False, False, {}


@pytest.mark.slow
def test_a_wall_takes_another_environment_and_more_cycles(monkeypatch):
    monkeypatch.setattr(own_task, "CYCLES", 60)
    assert own_task.train(WallRoom()) >= 0.65


@pytest.mark.slow
def test_stable_baselines3_trains_in_an_empty_folder(tmp_path):
    pytest.importorskip("stable_baselines3")
    for priority in ("consistency", "uniform", "her"):
        printed = run_alone(tmp_path, "with_stable_baselines3.py", priority, "0", "600")
        assert re.findall(r"num_timesteps=(\d+)", printed) == ["200", "400", "600"]


EPISODES, HORIZON = 6, 10


@pytest.fixture
def stable_baselines3_buffer():
    """VCPReplayBuffer with episodes in which each number says which episode and step it is of, and
    critics that differ by the step: Q_k = k·t, so that σ² = t²·σ²(k)."""
    pytest.importorskip("stable_baselines3")
    from gymnasium.spaces import Box, Dict

    example = importlib.import_module("with_stable_baselines3")

    def compute_reward(name, achieved, desired, infos, indices):
        return [(achieved == desired).all(axis=1) - 1.0]

    spaces = {"observation": 2, "achieved_goal": 1, "desired_goal": 1}
    space = Dict({key: Box(-1e3, 1e3, (size,)) for key, size in spaces.items()})
    buffer = example.VCPReplayBuffer(
        100,
        space,
        Box(-1, 1, (1,)),
        SimpleNamespace(env_method=compute_reward),
        priority="consistency",
        seed=0,
    )
    buffer.critic = lambda inputs, action: [k * inputs["observation"][:, 1:] for k in range(4)]

    def seen(e, t):
        goals = {"achieved_goal": [[10 * e + t]], "desired_goal": [[-1 - e]]}
        return {key: np.float32(x) for key, x in {"observation": [[e, t]], **goals}.items()}

    for e in range(EPISODES):
        for t in range(HORIZON):
            last = np.array([t == HORIZON - 1])
            action = np.float32([[t / HORIZON]])
            buffer.add(seen(e, t), seen(e, t + 1), action, np.array([-1.0]), last, [{}])
    return buffer


def test_stable_baselines3_replays_whole_transitions(stable_baselines3_buffer):
    batch = stable_baselines3_buffer.sample(500)
    e, t = batch.observations["observation"].numpy().T
    assert np.array_equal(batch.observations["achieved_goal"][:, 0], 10 * e + t)
    assert np.array_equal(batch.next_observations["observation"], np.stack([e, t + 1], axis=1))
    assert np.array_equal(batch.next_observations["achieved_goal"][:, 0], 10 * e + t + 1)
    assert np.allclose(batch.actions[:, 0] * 10, t)
    goal = batch.observations["desired_goal"][:, 0].numpy()
    assert np.array_equal(batch.next_observations["desired_goal"][:, 0], goal)
    assert np.array_equal(batch.rewards[:, 0], (goal == 10 * e + t + 1) - 1.0)
    original = goal < 0
    assert np.array_equal(goal[original], -1 - e[original])
    assert np.all((10 * e + t < goal) & (goal <= 10 * e + 10) | original)
    assert 0.6 < np.mean(~original) < 0.95


def test_stable_baselines3_draws_by_twice_the_temperature(stable_baselines3_buffer):
    batches = [stable_baselines3_buffer.sample(500) for _ in range(10)]
    t = np.concatenate([batch.observations["observation"][:, 1] for batch in batches])
    # Of (81 - t²)^18, t = 0, 1, ..., 9, the first three are .94; of (81 - t²)^9 they are .83.
    assert 0.9 < np.mean(t <= 2) < 0.97
