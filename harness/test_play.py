"""Tests of playing a run, and of policies."""

import itertools
import json
import shutil
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


def test_playing_a_run(whole, tmp_path, capsys):
    folder, picture = tmp_path / "from_a_gpu", tmp_path / "a.gif"
    shutil.copytree(whole, folder)
    records.write_config(folder, {**records.read_config(whole), "device": "cuda"})
    rates = play(folder, str(picture))
    out = capsys.readouterr().out
    assert rates.shape == (2,) and np.all((rates >= 0) & (rates <= 1))
    assert f"success {rates.mean():.3f} over 20 episodes" in out and "after epoch 4" in out
    assert f"by head: {rates[0]:.1f} {rates[1]:.1f}; the best is {rates.argmax()}" in out
    with Image.open(picture) as gif:
        assert gif.size == (360, 360) and gif.n_frames > 20
        frames = []
        for i in range(gif.n_frames):
            gif.seek(i)
            frames.append(np.asarray(gif.convert("RGB")).astype(int))
    assert np.abs(np.diff(frames, axis=0)).max() > 50  # something moves


def test_a_policy_acts_as_the_best_head_and_plays_without_the_run(
    whole, tmp_path, capsys, monkeypatch
):
    monkeypatch.delenv("DISPLAY", raising=False)
    file = tmp_path / "policy.npz"
    rates = play(whole, policy=str(file))
    assert f"head {rates.argmax()}" in capsys.readouterr().out
    assert file.stat().st_size < 1_000_000
    agent, _ = module.of_run(whole)
    its, about = read_policy(file)
    assert about == {
        "env": "PointMassEmptyEnv-v1",
        "episode_length": None,
        "method": "vcp",
        "seed": 0,
        "epoch": 4,
    }
    rows = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 1, 20, 2))
    head = int(rates.argmax())
    np.testing.assert_allclose(its.act(*rows), agent.act(*rows, slice(head, head + 1)), atol=1e-5)
    assert np.array_equal(play(file), rates[[head]])
    out = capsys.readouterr().out
    assert "over 10 episodes" in out and f"--play {file} --gif" in out and "by head" not in out


def test_the_best_head_is_the_one_that_is_kept(whole, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(module, "episode", lambda env, agent, head, seed: (head == 1, []))
    assert play(whole, policy=str(tmp_path / "policy.npz")).tolist() == [0, 1]
    assert "the best is 1" in capsys.readouterr().out
    (agent, _), (its, _) = module.of_run(whole), read_policy(tmp_path / "policy.npz")
    for ours, theirs in zip(its.actor.own[0], agent.actor.own[1], strict=True):
        assert torch.equal(ours, theirs)


def test_a_damaged_policy_or_one_of_another_task_is_refused(whole, tmp_path):
    file = tmp_path / "policy.npz"
    module.write_policy(file, *module.of_run(whole)[:1], 0, {"env": "x", "episode_length": None})
    with pytest.raises(UsageError, match="cannot make the environment x"):
        read_policy(file)
    about = {"env": "FetchReach-v1", "episode_length": None}
    module.write_policy(file, *module.of_run(whole)[:1], 0, about)
    with pytest.raises(UsageError, match="holds no policy"):  # of other sizes
        read_policy(file)
    whole_file = file.read_bytes()
    for place in np.random.default_rng(0).integers(len(whole_file), size=20):
        broken = bytearray(whole_file)
        broken[place] ^= 1 << 3
        file.write_bytes(broken)
        with pytest.raises(UsageError):
            read_policy(file)
    np.savez(file, about=np.array(json.dumps(about)), p0=np.array([print], dtype=object))
    with pytest.raises(UsageError, match="Object arrays cannot be loaded"):  # they would run code
        read_policy(file)


def test_what_is_looked_at_ends_at_the_goal_and_what_is_counted_does_not():
    env = make_env("PointMassEmptyEnv-v1")
    shown = make_env("PointMassEmptyEnv-v1", render_mode="rgb_array")
    heads, steps = [], itertools.count()
    towards = SimpleNamespace(act=lambda obs, goal, heads: np.clip(20 * (goal - obs), -1, 1))

    def there_and_back(obs, goal, its):
        heads.append(its)
        return towards.act(obs, goal, its) if next(steps) < 30 else -np.sign(goal)

    away = SimpleNamespace(act=lambda obs, goal, heads: np.clip(20 * (obs - goal), -1, 1))
    assert episode(env, towards, 0, seed=0) == (True, [])
    assert episode(env, SimpleNamespace(act=there_and_back), 3, seed=0) == (False, [])
    assert heads == 50 * [slice(3, 4)]
    success, frames = episode(shown, towards, 0, 0, "rgb_array")
    assert success and 10 <= len(frames) < 40
    success, frames = episode(shown, away, 0, 0, "rgb_array")
    assert not success and len(frames) == 50


def test_playing_takes_one_thread(whole, monkeypatch):
    """With more, each action waits for every core that is busy."""
    threads, act = set(), EnsembleDDPG.act

    def noted(self, *args):
        threads.add(torch.get_num_threads())
        return act(self, *args)

    monkeypatch.setattr(EnsembleDDPG, "act", noted)
    monkeypatch.delenv("DISPLAY", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    play(whole)
    assert threads == {1} and torch.get_num_threads() == 2
    torch.set_num_threads(before)
