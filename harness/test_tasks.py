"""Tests of the names, of what is refused, and of goal environments as they are out there."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import run
from ensemble import EnsembleDDPG
from harness.errors import UsageError
from harness.tasks import PAPER_ENVS, examine, make_env
from harness.testing import SMALL_TRAINING, Tracker
from harness.workers import ParallelEnvs
from her import EpisodeBuffer
from run import Config, train
from vcp import HERBuffer, update_her_buffer


def test_the_papers_names():
    assert len(PAPER_ENVS) == 16
    assert make_env("FetchSilce-v1").spec.id == "FetchSlide-v4"  # as Appendix A misprints them
    assert make_env("FetchPickAndPlac-v1").spec.id == "FetchPickAndPlace-v4"
    assert make_env("FetchPush-v4").spec.max_episode_steps == 50
    assert make_env("HandManipulateEggFull-v1").spec.max_episode_steps == 100  # its own length
    assert make_env("HandManipulateEggFull-v0").spec.max_episode_steps == 50  # the paper's
    assert "HandReach-v3" in examine("HandReach-v0").made


class Unlearnable(Tracker):
    """`Tracker` with one thing changed."""

    def __init__(self, **changes):
        for name, value in changes.items():
            setattr(self, name, value)


gym.register("Unlearnable-v0", Unlearnable, max_episode_steps=7)


gym.register("Endless-v0", Tracker)


def test_actions_are_rescaled_to_the_environments_bounds():
    env = make_env("Tracker-v0")
    env.reset(seed=0)
    for action, expected in (([-1, -1], [0, -5]), ([1, 1], [10, 5]), ([0, 0.5], [5, 2.5])):
        env.step(np.float32(action))
        np.testing.assert_allclose(env.unwrapped.last, expected)


@pytest.mark.parametrize(
    ("changes", "missing"),
    [
        ({"observation_space": gym.spaces.Box(-1, 1, (3,))}, "no goals"),
        ({"action_space": gym.spaces.Discrete(3)}, "not a flat Box"),
        ({"action_space": gym.spaces.Box(-np.inf, np.inf, (2,))}, "no bounds"),
        ({"compute_reward": None}, "no compute_reward"),
        ({"compute_reward": lambda a, d, i: -1.0}, "not vectorised"),
        ({"compute_reward": lambda a, d, i: -np.abs(a - d)[:, 0]}, "-1 and 0"),
        ({"compute_reward": lambda a, d, i: 2.0 * (a == d)[:, 0]}, "-1 and 0"),
    ],
)
def test_environments_that_cannot_be_learned(changes, missing):
    with pytest.raises(UsageError, match=missing):
        make_env("Unlearnable-v0", **changes)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("CartPole-v1", "has no goals"),
        ("Endless-v0", "no episode length"),
        ("FetchReach-v9", "the nearest names are .*FetchReach-v4"),
        ("FetchRaech-v1", "the nearest names are .*FetchReach-v1"),
        ("FetchReach-v2", "FetchReach-v4"),  # deprecated
        ("no_such_module:Env-v0", "no_such_module"),
        ("FetchReachDense-v4", "-1 and 0"),
        ("", "cannot make"),
    ],
)
def test_names_that_cannot_be_made(name, message):
    with pytest.raises(UsageError, match=message) as error:
        make_env(name)
    assert "\n" not in str(error.value)


def test_an_environment_from_outside_trains(tmp_path):
    (row,) = train(
        Config(**SMALL_TRAINING, env="Tracker-v0", num_workers=1, out=str(tmp_path / "run"))
    )
    assert row["env_steps"] == 3 * 16 * 7


def test_a_module_and_its_id_name_an_environment(tmp_path, monkeypatch):
    text = "import gymnasium, harness.testing\n"
    text += "gymnasium.register('Own-v0', harness.testing.Tracker, max_episode_steps=5)\n"
    (tmp_path / "own_module.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    assert make_env("own_module:Own-v0").spec.max_episode_steps == 5


@pytest.mark.parametrize("name", PAPER_ENVS)
def test_one_cycle_of_each_of_the_sixteen(name):
    """Collect, relabel, score, update: shapes, rewards, episode length."""
    env = make_env(name)
    dims = {k: env.observation_space[k].shape[0] for k in ("observation", "desired_goal")}
    obs_dim, goal_dim = dims.values()
    action_dim = env.action_space.shape[0]
    assert env.spec.max_episode_steps == 50
    assert (obs_dim, goal_dim, action_dim) == {
        "Fetch": (25, 3, 4),
        "HandR": (63, 15, 20),
        "HandM": (61, 7, 20),
        "Reach": (8, 2, 2),
        "Point": (2, 2, 2),
    }[name[:5]] or name == "FetchReach-v1"
    agent = EnsembleDDPG(obs_dim, goal_dim, action_dim, gamma=0.98, heads=2)
    rng = np.random.default_rng(0)
    with ParallelEnvs(name, 2, 1) as envs:
        envs.reset(0)
        policy = run.exploring(run.greedy(agent, 2, 2), rng, (50, 2, action_dim), 0.2, 0.3)
        episodes, success = run.rollout(envs, policy, 50)
    assert episodes["obs"].shape == (2, 51, obs_dim) and success.shape == (2,)
    assert episodes["achieved_goal"].shape == (2, 51, goal_dim)
    original = EpisodeBuffer(1000, 50, obs_dim, goal_dim, action_dim)
    original.add(episodes, rng)
    buffer = HERBuffer(256, 9.0)

    def reward_fn(achieved, desired):
        return env.unwrapped.compute_reward(achieved, desired, {})

    update_her_buffer(original, buffer, agent.q_variance, 256, rng, 0.8, reward_fn)
    rewards = buffer.data["reward"]
    assert set(np.unique(rewards)) == {-1.0, 0.0} and rewards.dtype == np.float32
    for k in range(2):
        assert torch.isfinite(agent.update_head(k, buffer.sample(64, rng))).all()
