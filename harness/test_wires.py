"""Tests that every setting reaches the part that uses it, and that each column of progress.csv is
what it says. Expected values are literals. The line below a test's name says what would be wrong.
"""

from dataclasses import fields

import numpy as np
import pytest

from baselines.cher import CHER
from baselines.dtgsh import DTGSH
from baselines.her import HERReplay
from baselines.herebp import HEREBP
from harness.assemble import assemble
from harness.settings import Config, complete, variant
from harness.tasks import PAPER_ENVS
from harness.testing import SPIED, spied_run


def test_each_setting_arrives():
    """An option would be accepted and do nothing."""
    calls = spied_run().calls
    (agent,), (b_o,), (b_h,) = calls["agent"], calls["B_o"], calls["B_h"]
    assert agent.kwargs == {
        "obs_dim": 2,
        "goal_dim": 2,
        "action_dim": 2,
        "num_heads": 4,
        "gamma": 0.95,  # 1 - 1/20
        "learning_rate": 2e-3,
        "polyak": 0.9,
        "action_penalty": 0.33,
        "device": "cpu",
        "seed": 5,
    }
    assert b_o.args[:6] == (700, 20, 2, 2, 2, 0.6)
    assert b_h.kwargs == {
        "capacity": 650,
        "temperature": 3.0,
        "priority": "variance",
        "importance": "inverse",
    }
    assert {call.args[3] for call in calls["relabel"]} == {0.6}
    # T, environments, actions; the first episodes are all random
    explored = [((20, 16, 2), 0.11, share) for share in (1, 0.22, 0.22, 0.22)]
    assert [call.args[1:] for call in calls["explore"]] == explored
    assert {len(call.result["obs"]) for call in calls["draw"]} == {24}
    assert len(calls["update"]) == 3 * 2 * 2  # cycles, updates, 4 heads by two
    assert {len(call.result[1]) for call in calls["score"]} == {144}  # 4 heads x 24 x 1.5
    assert len(calls["value"]) == 3  # rounds of 16 tests, for 40


def test_the_normaliser_sees_relabelled_goals_and_all_steps_of_the_new_episodes():
    """The networks' inputs would be standardised by other numbers than they are."""
    calls = spied_run().calls
    assert len(calls["relabel"]) == len(calls["normalise"]) == 4
    for relabel, normalise in zip(calls["relabel"], calls["normalise"], strict=True):
        batch = relabel.result
        assert len(relabel.args[0]["obs"]) == 16  # not the episodes before these
        assert len(batch["obs"]) == 320 and 0.5 < batch["hindsight"].mean() < 0.7
        np.testing.assert_array_equal(normalise.args[1], np.hstack([batch["obs"], batch["goal"]]))


def test_evaluation_has_no_noise_and_looks_at_what_the_heads_saw():
    """The tests would be of another policy, or Q of another state or goal."""
    calls = spied_run().calls
    tests = [call.result[0] for call in calls["rollout"][4:]]
    acted = np.stack([call.result for call in calls["act"][4 * 20 :]]).reshape(3, 20, 16, 2)
    played = np.stack([episodes["action"] for episodes in tests]).transpose(0, 2, 1, 3)
    np.testing.assert_array_equal(acted, played)
    for episodes, value in zip(tests, calls["value"], strict=True):
        obs, goal = (x.reshape(16, 20, 2) for x in value.args[1:])
        np.testing.assert_array_equal(obs, episodes["obs"][:, :20])
        np.testing.assert_array_equal(goal[:, 7], episodes["desired_goal"])


def test_the_columns_are_what_they_say():
    """A figure would show something else than the axis says."""
    calls, row = spied_run().calls, spied_run().row
    success = [call.result[1] for call in calls["rollout"]]  # the warm-up, 3 cycles, 3 tests
    losses = np.concatenate([call.result for call in calls["update"]])
    values = [call.result for call in calls["value"]]
    drawn = [call.result for call in calls["draw"]]
    by_weight = [b["weight"][~b["hindsight"]].sum() / b["weight"].sum() for b in drawn]
    (agent,), (b_h,) = (calls[name] for name in ("agent", "B_h"))
    rows = b_h.result.data
    variance = agent.result.q_variance(rows["obs"], rows["action"], rows["goal"])
    expected = {
        "epoch": 1,
        "env_steps": 16 * 20 * 4,
        "test_success_rate": np.mean(success[4:]),
        "train_success_rate": np.mean(success[1:4]),
        "test_q": np.mean(values),
        "critic_loss": losses[:, 0].mean(),
        "actor_loss": losses[:, 1].mean(),
        "variance_hindsight": variance[rows["hindsight"]].mean(),
        "variance_original": variance[~rows["hindsight"]].mean(),
        "batch_original_fraction": np.mean([1 - b["hindsight"].mean() for b in drawn]),
        "her_buffer_size": 650,
        "loss_original_fraction": np.mean(by_weight),
    }
    np.testing.assert_allclose([row[name] for name in expected], [*expected.values()], rtol=1e-3)
    for one, other in (("variance_hindsight", "variance_original"), ("critic_loss", "actor_loss")):
        assert abs(row[one] - row[other]) > 0.1 * abs(row[one])  # neither is taken for the other
    assert abs(row["batch_original_fraction"] - row["loss_original_fraction"]) > 0.01
    assert 0 < row["collect_seconds"] + row["train_seconds"] < row["wall_seconds"]
    assert row["eval_seconds"] > 0


@pytest.mark.parametrize(
    ("method", "settings", "expected"),
    [
        (HERReplay, {"updates": 4}, {"at_once": 16}),
        (CHER, {"cycles": 3, "updates": 4}, {"updates": 12, "heads": 4}),
        (DTGSH, {}, {"sigma": 0.5, "most": 0.001}),
        (HEREBP, {}, {"settings": (0.04, 0.5)}),
    ],
)
def test_the_other_methods_get_theirs(method, settings, expected):
    """Another method would be compared with settings of VCP's, or of another task."""
    name = method.__name__.lower().removesuffix("replay")
    common = {"env": "FetchPush-v1", "heads": 4, "relabel_ratio": 0.6}
    replay = assemble(complete(Config(method=name, **common, **settings))).replay
    assert type(replay) is method and replay.buffer.relabel_ratio == 0.6
    assert {k: getattr(replay, k) for k in expected} == expected


def test_every_setting_is_in_the_runs_name_or_may_change():
    """Two runs with different settings would share a folder."""
    named = variant(complete(Config(**SPIED)))
    unnamed = {"env", "seed", "out", "epochs", "device", "threads", "num_workers", "method"}
    for f in fields(Config):
        assert (f"{f.name}-" in named) == (f.name not in unnamed), f.name


def test_a_name_of_the_papers_makes_the_environment_of_that_name():
    """A run would be of another task than the folder's name says."""
    for name, ours in PAPER_ENVS.items():
        assert ours.removeprefix("Sparse").partition("-v")[0] == name.partition("-v")[0]
