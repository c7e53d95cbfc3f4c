"""Tests of a run's parts."""

import numpy as np
import pytest

import run
from harness.assemble import assemble, load
from harness.errors import UsageError
from harness.settings import complete
from harness.testing import SMALL
from run import Config


def test_a_run_is_loaded_to_act(tmp_path):
    run.train(Config(**SMALL, epochs=1, episode_length=20, out=str(tmp_path / "run")))
    agent, env = load(tmp_path / "run", render_mode="rgb_array")
    assert env.spec.max_episode_steps == 20
    obs, _ = env.reset(seed=0)
    action = agent.act(obs["observation"][None, None], obs["desired_goal"][None, None], slice(1))
    assert env.action_space.contains(action[0, 0]) and env.render().ndim == 3
    again, _ = load(str(tmp_path / "run"))
    rows = np.zeros((2, 3, 2))
    np.testing.assert_allclose(agent.act(rows, rows), again.act(rows, rows), atol=1e-6)
    with pytest.raises(UsageError, match="does not hold a run"):
        load(tmp_path)


def test_a_thread_a_core_or_as_many_as_are_asked_for(monkeypatch):
    """Where heads take turns the main thread is one of them."""
    monkeypatch.setattr("harness.assemble.available_cores", lambda: [0, 1, 2, 3])
    for threads, at_once, made in ((None, 4, 4), (None, 1, 3), (3, 2, 3), (3, 1, 2), (1, 1, 1)):
        given = {"heads": 4, "heads_at_once": at_once, "threads": threads}
        parts = assemble(complete(Config(env="PointMassEmptyEnv-v1", **given)))
        assert parts.threads() == made


@pytest.mark.parametrize(
    ("heads", "workers", "halves"), [(2, 1, 1), (2, 2, 2), (1, 2, 2), (3, 2, 1), (4, 4, 2)]
)
def test_each_half_has_the_environments_of_whole_heads_or_of_the_only_one(heads, workers, halves):
    config = {**SMALL, "heads": heads, "num_workers": workers}
    parts = assemble(complete(Config(**config, epochs=1)))
    policy = run.acting_heads(parts.agent, heads, parts.num_envs)
    with parts.envs() as envs:
        assert (envs.num_workers, len(envs.halves)) == (workers, halves)
        envs.reset(0)
        run.rollout(envs, policy, 2)


def test_the_line_of_the_environment_says_which_action_penalty_is_not_hers():
    for given, said in ((None, False), (1.0, False), (0.1, True)):
        config = complete(Config(env="PointMassEmptyEnv-v1", action_penalty=given))
        assert ("action penalty 0.1 (1 is HER's" in assemble(config).task.made) == said
