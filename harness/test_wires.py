"""Tests that every setting reaches the part that uses it, and that each column of progress.csv is
what it says. Expected values are literals."""

from dataclasses import fields

import numpy as np
import pytest
import torch

import run
from baselines.cher import CHER
from baselines.dtgsh import DTGSH
from baselines.her import HERReplay
from baselines.herebp import HEREBP
from ensemble import EnsembleDDPG, Normalizer
from envs_point import PointMass, SparseReacher
from harness import assemble as rooms
from harness.assemble import assemble
from harness.settings import Config, complete, variant
from harness.tasks import PAPER_ENVS, make_env
from run import train
from vcp import HERBuffer

SETTINGS = {  # none of them a default
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
    "her_buffer_capacity": 333,
    "priority": "variance",
    "acting_head": "one",
    "num_workers": 1,
}


@pytest.fixture
def spied(tmp_path, monkeypatch):
    """A run with these settings, and what its parts were given."""
    seen = {name: [] for name in ("agent", "b_h", "ratio", "exploration", "acted", "normalised")}
    seen |= {name: [] for name in ("success", "losses", "steps", "batches", "values", "b_o")}

    def spy(owner, name, key, take):
        original = getattr(owner, name)

        def replacement(*args, **kwargs):
            result = original(*args, **kwargs)
            seen[key].append(take(args, kwargs, result))
            return result

        monkeypatch.setattr(owner, name, replacement)

    spy(rooms, "EnsembleDDPG", "agent", lambda a, k, result: (k, result))
    spy(rooms, "HERBuffer", "b_h", lambda a, k, result: (k, result))
    spy(run, "relabel_future", "ratio", lambda a, k, result: (a[3], len(a[0]["obs"]), result))
    spy(Normalizer, "update", "normalised", lambda a, k, result: a[1])
    spy(run, "exploration", "exploration", lambda a, k, result: a[1:])
    spy(run, "rollout", "success", lambda a, k, result: result)
    spy(EnsembleDDPG, "act", "acted", lambda a, k, result: (a[1].shape, result))
    spy(EnsembleDDPG, "value", "values", lambda a, k, result: (*a[1:], result))
    spy(EnsembleDDPG, "update_heads", "losses", lambda a, k, result: result.numpy())
    spy(rooms, "EpisodeBuffer", "b_o", lambda a, k, result: a)
    spy(torch.optim.Adam, "step", "steps", lambda a, k, result: None)
    spy(HERBuffer, "sample", "batches", lambda a, k, result: result)
    scored = []
    score = run.score
    monkeypatch.setattr(run, "score", lambda *a: (scored.append(a[2]), score(*a))[1])
    (row,) = train(Config(**SETTINGS, out=str(tmp_path / "run")))
    return seen, scored, row


def test_each_setting_arrives(spied):
    seen, scored, _ = spied
    ((agent, _),), ((b_h, _),) = seen["agent"], seen["b_h"]
    assert agent["num_heads"] == 4 and agent["gamma"] == 0.95  # 1 - 1/20
    assert agent["learning_rate"] == 2e-3
    assert agent["polyak"] == 0.9 and agent["action_penalty"] == 0.33
    assert agent["seed"] == 5 and agent["device"] == "cpu"
    assert b_h == {
        "capacity": 333,
        "temperature": 3.0,
        "priority": "variance",
        "importance": "inverse",
    }
    # the normaliser's goals and those that Algorithm 1 scores; 4 heads x 24 transitions x 1.5
    assert {ratio for ratio, *_ in seen["ratio"]} == {0.6} and set(scored) == {144}
    assert seen["b_o"][0][:6] == (700, 20, 2, 2, 2, 0.6)
    # T, environments, actions; the warm-up is all random
    assert seen["exploration"] == [((20, 16, 2), 0.11, share) for share in (1, 0.22, 0.22, 0.22)]
    assert {len(batch["obs"]) for batch in seen["batches"]} == {24}
    assert len(seen["losses"]) == len(seen["steps"]) == 3 * 2 * 2  # heads_at_once of 4
    # 4 collections by one head in 16 environments, 3 rounds of 16 test episodes by all heads
    shapes = [shape for shape, _ in seen["acted"]]
    assert shapes == 4 * 20 * [(1, 16, 2)] + 3 * 20 * [(4, 4, 2)]


def test_the_normaliser_sees_relabelled_goals_and_all_steps_of_the_new_episodes(spied):
    seen, _, _ = spied
    assert len(seen["ratio"]) == len(seen["normalised"]) == 4
    for (_, episodes, batch), x in zip(seen["ratio"], seen["normalised"], strict=True):
        assert episodes == 16  # not those before them
        assert len(batch["obs"]) == 320 and 0.5 < batch["hindsight"].mean() < 0.7
        np.testing.assert_array_equal(x, np.hstack([batch["obs"], batch["goal"]]))


def test_evaluation_has_no_noise_and_all_its_rounds(spied):
    seen, _, row = spied
    tests = seen["success"][4:]
    assert len(tests) == 3 and len(seen["values"]) == 3
    acted = np.stack([action for _, action in seen["acted"][80:]]).reshape(3, 20, 16, 2)
    played = np.stack([episodes["action"] for episodes, _ in tests]).transpose(0, 2, 1, 3)
    np.testing.assert_array_equal(acted, played)
    assert row["test_success_rate"] == np.mean([success for _, success in tests])
    # Q of what the heads saw before they acted, with the goal they were to reach
    for (episodes, _), (obs, goal, _) in zip(tests, seen["values"], strict=True):
        np.testing.assert_array_equal(obs.reshape(16, 20, 2), episodes["obs"][:, :20])
        np.testing.assert_array_equal(goal.reshape(16, 20, 2)[:, 7], episodes["desired_goal"])


def test_the_columns_are_what_they_say(spied):
    seen, _, row = spied
    losses = np.concatenate(seen["losses"]).mean(axis=0)
    np.testing.assert_allclose([row["critic_loss"], row["actor_loss"]], losses, rtol=1e-5)
    assert row["train_success_rate"] == np.mean([s for _, s in seen["success"][1:4]])
    np.testing.assert_allclose(row["test_q"], np.mean([q for *_, q in seen["values"]]), rtol=1e-5)
    originals = np.mean([1 - batch["hindsight"].mean() for batch in seen["batches"]])
    np.testing.assert_allclose(row["batch_original_fraction"], originals)
    pairs = [(batch["weight"], ~batch["hindsight"]) for batch in seen["batches"]]
    by_weight = np.mean([weight[kind].sum() / weight.sum() for weight, kind in pairs])
    np.testing.assert_allclose(row["loss_original_fraction"], by_weight, rtol=1e-5)
    assert abs(by_weight - originals) > 0.01
    assert row["epoch"] == 1 and row["env_steps"] == 16 * 20 * 4
    assert row["her_buffer_size"] == 333
    ((_, agent),), ((_, b_h),) = seen["agent"], seen["b_h"]
    variance = agent.q_variance(*(b_h.data[name] for name in ("obs", "action", "goal")))
    hindsight = b_h.data["hindsight"]
    expected = [variance[hindsight].mean(), variance[~hindsight].mean()]
    ours = [row["variance_hindsight"], row["variance_original"]]
    np.testing.assert_allclose(ours, expected, rtol=1e-3)
    assert abs(ours[0] - ours[1]) > 0.1 * ours[0]  # so that one is not taken for the other
    assert 0 < row["collect_seconds"] + row["train_seconds"] + row["eval_seconds"]
    assert row["collect_seconds"] + row["train_seconds"] < row["wall_seconds"]


@pytest.mark.parametrize(
    ("method", "settings", "expected"),
    [
        (HERReplay, {"updates": 4}, {"at_once": 16}),
        (CHER, {"cycles": 3, "updates": 4}, {"updates": 12}),
        (DTGSH, {}, {"sigma": 0.5, "most": 0.001}),
        (HEREBP, {}, {"settings": (0.04, 0.5)}),
    ],
)
def test_the_other_methods_get_theirs(method, settings, expected):
    name = method.__name__.lower().removesuffix("replay")
    common = {"env": "FetchPush-v1", "heads": 4, "relabel_ratio": 0.6}
    replay = assemble(complete(Config(method=name, **common, **settings))).replay
    assert type(replay) is method and replay.buffer.relabel_ratio == 0.6
    assert {k: getattr(replay, k) for k in expected} == expected
    assert name != "cher" or replay.heads == 4


def test_every_setting_is_in_the_runs_name_or_may_change():
    named = variant(complete(Config(**SETTINGS)))
    unnamed = {
        "env",
        "seed",
        "out",
        "epochs",
        "device",
        "threads",
        "num_workers",
        "method",
    }
    for f in fields(Config):
        assert (f.name in named) == (f.name not in unnamed), f.name


def test_the_papers_environments_are_these():
    assert PAPER_ENVS == {
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
    for name in PAPER_ENVS:
        assert make_env(name).spec.id == PAPER_ENVS[name]


@pytest.mark.parametrize(("env", "within"), [(PointMass(), 0.05), (SparseReacher(), 0.02)])
def test_our_thresholds(env, within):
    goal = np.zeros((2, 2))
    achieved = np.array([[within - 1e-6, 0], [0, within + 1e-6]])
    assert env.compute_reward(achieved, goal, {}).tolist() == [0, -1]
    env.reset(seed=0)
    if isinstance(env, PointMass):
        env._xy, env._goal = (0.1, 0.1), (0.1, 0.1 + within - 1e-6)
        assert env.step([0, 0])[4]["is_success"]
        env._goal = (0.1, 0.1 + within + 1e-6)
        assert not env.step([0, 0])[4]["is_success"]
        x = env.step([1, -1])[0]["achieved_goal"]
        np.testing.assert_allclose(x, [0.15, 0.05])
        for _ in range(40):
            x = env.step([1, 1])[0]["achieved_goal"]
        np.testing.assert_allclose(x, [0.55, 0.55])
