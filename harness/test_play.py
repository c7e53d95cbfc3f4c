"""Tests of playing a run, and of policies."""

import itertools
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from ensemble import EnsembleDDPG
from harness import play as module
from harness import records
from harness.errors import UsageError
from harness.play import episode, play, read_policy
from harness.tasks import make_env


@pytest.fixture(autouse=True)
def without_a_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)


def test_playing_a_run(whole, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(module, "SHOWN", 1)
    folder, picture = tmp_path / "from_a_gpu", tmp_path / "a.gif"
    shutil.copytree(whole, folder)
    records.write_config(folder, {**records.read_config(whole), "device": "cuda"})
    rates = play(folder, str(picture))
    out = capsys.readouterr().out
    assert rates.shape == (2,) and np.all((rates >= 0) & (rates <= 1))
    assert f"success {rates.mean():.3f} over 20 episodes" in out and "after epoch 4" in out
    assert f"by head: {rates[0]:.1f} {rates[1]:.1f}; the best is {rates.argmax()}" in out
    with Image.open(picture) as gif:
        first = np.asarray(gif.convert("RGB")).astype(int)
        gif.seek(gif.n_frames - 1)
        assert gif.size == (360, 360) and gif.n_frames > 9
        assert np.abs(np.asarray(gif.convert("RGB")) - first).max() > 50  # something moves


def test_a_policy_acts_as_the_best_head_and_plays_without_the_run(
    whole, tmp_path, capsys, monkeypatch
):
    file = tmp_path / "policy.npz"
    with monkeypatch.context() as patch:  # head 0 succeeds in the tenth episode
        won = lambda env, agent, head, seed: (head == 1 or seed == 1_000_009, [])  # noqa: E731
        patch.setattr(module, "episode", won)
        assert play(whole, policy=str(file)).tolist() == [0.1, 1]
    assert "the best is 1" in capsys.readouterr().out and file.stat().st_size < 1_000_000
    (agent, _), (policy, about) = module.of_run(whole), read_policy(file)
    expected = {"env": "PointMassEmptyEnv-v1", "episode_length": None, "method": "vcp", "seed": 0}
    assert about == {**expected, "epoch": 4}
    rows = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 1, 20, 2))
    np.testing.assert_allclose(policy.act(*rows), agent.act(*rows, slice(1, 2)), atol=1e-5)
    monkeypatch.chdir(tmp_path)
    rates = play(Path("policy.npz"))
    out = capsys.readouterr().out
    assert "over 10 episodes" in out and f"--play {file} --gif" in out and "by head" not in out
    assert np.array_equal(rates, play(whole)[[1]])


def test_a_damaged_policy_or_one_of_another_task_is_refused(whole, tmp_path):
    file, (agent, _) = tmp_path / "policy.npz", module.of_run(whole)
    for env, message in (("x", "in the environment x"), ("FetchReach-v1", "no policy")):
        module.write_policy(file, agent, 0, {"env": env, "episode_length": None})
        with pytest.raises(UsageError, match=message):
            read_policy(file)
    whole_file = file.read_bytes()
    for place in np.random.default_rng(0).integers(len(whole_file), size=20):
        broken = bytearray(whole_file)
        broken[place] ^= 1 << 3
        file.write_bytes(broken)
        with pytest.raises(UsageError):
            read_policy(file)
    about = {"env": "FetchReach-v1", "episode_length": None}
    np.savez(file, about=np.array(json.dumps(about)), p0=np.array([print], dtype=object))
    with pytest.raises(UsageError, match="Object arrays cannot be loaded"):  # they would run code
        read_policy(file)


def test_what_is_looked_at_ends_at_the_goal_and_what_is_counted_does_not():
    env = make_env("PointMassEmptyEnv-v1")
    shown = make_env("PointMassEmptyEnv-v1", render_mode="rgb_array")
    asked, steps = [], itertools.count()
    towards = SimpleNamespace(act=lambda obs, goal, heads: np.clip(20 * (goal - obs), -1, 1))

    def there_and_back(obs, goal, heads):
        asked.append(heads)
        return towards.act(obs, goal, heads) if next(steps) < 30 else -np.sign(goal)

    away = SimpleNamespace(act=lambda obs, goal, heads: np.clip(20 * (obs - goal), -1, 1))
    assert episode(env, towards, 0, seed=0) == (True, [])
    assert episode(env, SimpleNamespace(act=there_and_back), 3, seed=0) == (False, [])
    assert asked == 50 * [slice(3, 4)]
    success, frames = episode(shown, towards, 0, 0, "rgb_array")
    assert success and 10 <= len(frames) < 40
    success, frames = episode(shown, away, 0, 0, "rgb_array")
    assert not success and len(frames) == 50


def test_an_environment_without_a_window_is_played_on_a_desktop_too(whole, monkeypatch, capsys):
    monkeypatch.setenv("DISPLAY", ":99")
    play(whole)
    assert "no window; for an animation" in capsys.readouterr().out


def test_playing_takes_one_thread(whole, monkeypatch):
    """With more, each action waits for every core that is busy."""
    threads, before = set(), torch.get_num_threads()

    def act(self, *args):
        threads.add(torch.get_num_threads())
        return np.zeros((1, 1, 2))

    monkeypatch.setattr(EnsembleDDPG, "act", act)
    torch.set_num_threads(2)
    play(whole)
    assert threads == {1} and torch.get_num_threads() == 2
    torch.set_num_threads(before)
