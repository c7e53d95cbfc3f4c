"""Tests of the settings and the schedule."""

import pytest
import torch

from harness import settings
from harness.errors import UsageError
from harness.settings import Config
from harness.tasks import PAPER_ENVS


def test_the_schedule_is_appendix_b():
    schedule = {name: tuple(settings.paper_schedule(name).values()) for name in PAPER_ENVS}
    assert schedule.pop("FetchReach-v1")[:3] == (5, 5, 64)
    assert schedule.pop("Reacher-v2")[:3] == (15, 5, 64)
    assert {s[:3] for s in schedule.values()} == {(50, 40, 256)}
    assert settings.complete(Config(env="gymnasium_robotics:FetchReach-v4")).updates == 5
    c = settings.complete(Config())
    assert (c.heads, c.epochs, c.eval_episodes, c.buffer_size) == (16, 50, 160, 1_000_000)
    assert (c.relabel_ratio, c.learning_rate, c.polyak) == (0.8, 1e-3, 0.95)
    assert (c.noise, c.random_actions, c.action_penalty, c.temperature) == (0.2, 0.3, 1.0, 9.0)


def test_the_papers_tasks_have_hers_action_penalty_and_others_a_tenth():
    paper = [*PAPER_ENVS, *PAPER_ENVS.values(), "gymnasium_robotics:FetchPush-v4"]
    assert {settings.complete(Config(env=env)).action_penalty for env in paper} == {1.0}
    for env in ("line:Line-v0", "gymnasium_robotics:PointMaze_UMaze-v3"):
        assert settings.complete(Config(env=env)).action_penalty == 0.1
        assert settings.complete(Config(env=env, action_penalty=1)).action_penalty == 1.0
        assert settings.variant(settings.complete(Config(env=env))) == "vcp"


@pytest.mark.parametrize(
    "given, together",
    [
        ({}, 1),
        ({"env": "FetchPush-v1"}, 16),
        ({"env": "FetchPush-v1", "updates": 5}, 1),
        ({"env": "HandReach-v0", "heads": 4, "method": "dtgsh"}, 4),
        ({"env": "FetchPush-v1", "heads": 1, "method": "her"}, 1),
        ({"env": "FetchPush-v1", "heads_at_once": 8}, 8),
    ],
)
def test_with_many_updates_the_heads_step_together(given, together):
    assert settings.complete(Config(**given)).heads_at_once == together


@pytest.mark.parametrize(
    "given",
    [
        {"relabel_ratio": 0.0, "polyak": 0.0, "random_actions": 0.0, "noise": 0.0, "seed": 0},
        {"relabel_ratio": 1.0, "polyak": 1.0, "random_actions": 1.0, "seed": 2**32 - 1},
        {"action_penalty": 0.0, "temperature": 0.0, "heads": 1, "updates": 1, "batch_size": 1},
        {"epochs": 1, "cycles": 1, "eval_episodes": 1, "episode_length": 1, "buffer_size": 1},
        {"heads_at_once": 1, "num_workers": 1, "her_buffer_capacity": 16_384},
    ],
)
def test_the_ends_of_a_range_belong_to_it(given):
    config = settings.complete(Config(env="FetchPush-v1", **given))
    assert {name: getattr(config, name) for name in given} == given


def test_what_is_scored_fits_into_the_buffer():
    sweep = {"heads": 4, "batch_size": 8}  # draws 32
    for given, capacity in (
        ({"updates": 5}, 160),
        ({"updates": 1, "scored_per_drawn": 2.5}, 80),
        ({"updates": 1, "scored_per_drawn": 2.49}, 80),  # the nearest number
        ({"updates": 5, "her_buffer_capacity": 40}, 40),
    ):
        assert settings.complete(Config(**sweep, **given)).her_buffer_capacity == capacity


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_missing_device_is_named():
    with pytest.raises(UsageError, match="no CUDA device"):
        settings.complete(Config(device="cuda"))
    assert settings.complete(Config(device="auto")).device == "cpu"


@pytest.mark.parametrize(
    ("given", "device"),
    [
        ({"env": "FetchPush-v1"}, "cuda"),
        ({"env": "FetchPush-v1", "heads": 1, "method": "her"}, "cuda"),
        ({"env": "FetchPush-v1", "heads_at_once": 8}, "cpu"),
        ({"env": "FetchReach-v1"}, "cpu"),
        ({"env": "FetchReach-v1", "heads": 1, "method": "her"}, "cpu"),
        ({"env": "FetchReach-v1", "device": "cuda"}, "cuda"),
        ({"env": "FetchPush-v1", "device": "cpu"}, "cpu"),
    ],
)
def test_a_gpu_is_taken_where_it_is_faster(given, device, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert settings.complete(Config(**given)).device == device
