"""Tests of the environments in their processes."""

import os
import signal

import numpy as np
import pytest

import run
from harness.tasks import make_env
from harness.testing import random_agent
from harness.workers import Half, ParallelEnvs, number_of_workers, read_joints_by_index

POINTS = "PointMassEmptyEnv-v1"


@pytest.mark.parametrize(
    ("name", "sizes"), [("FetchReach-v1", (10, 3, 4)), ("PointMassWallEnv-v1", (2, 2, 2))]
)
def test_workers_play_the_same_as_one_process(name, sizes):
    """With the same seeds; a product of fewer rows may round otherwise (NOTES.md)."""
    agent, played = random_agent(2, 0, *sizes), []
    for workers in (1, 2, 4):
        with ParallelEnvs(name, 4, workers, in_halves=workers > 1) as envs:
            assert envs.num_workers == workers
            envs.reset(7)
            noise = run.exploration(np.random.default_rng(0), (5, 4, sizes[2]), 0.2, 0.3)
            episodes, success = run.rollout(envs, run.acting_heads(agent, 2, 4, noise), 5)
        apart = np.linalg.norm(episodes["achieved_goal"][:, -1] - episodes["desired_goal"], axis=1)
        np.testing.assert_array_equal(success, apart < 0.05)
        played.append(episodes)
    for key, array in played[0].items():
        for other in (played[1][key], played[2][key]):
            np.testing.assert_allclose(other, array, atol=1e-4)
            if key != "action":
                np.testing.assert_array_equal(other[:, 0], array[:, 0])
        assert len({row.tobytes() for row in array}) == 4  # no two have one seed
        assert array.dtype == np.float32


def test_as_many_workers_as_cores_share_the_environments_evenly(monkeypatch):
    for num_envs, asked, made in ((16, 5, 4), (18, 4, 3), (18, 9, 9), (16, 99, 16), (3, 2, 1)):
        assert number_of_workers(asked, num_envs) == made
    for cores, made in ((1, 1), (2, 2), (3, 2), (16, 16), (64, 16)):
        monkeypatch.setattr("harness.workers.available_cores", lambda n=cores: [*range(n)])
        assert number_of_workers(None, 16) == made
    for num_workers, in_halves in ((4, False), (3, True)):
        with pytest.raises(ValueError, match=f"{num_workers} workers cannot share 18"):
            ParallelEnvs(POINTS, 18, num_workers, in_halves)


def test_one_half_acts_while_the_other_steps(monkeypatch):
    events = []

    def noted(name):
        method = getattr(Half, name)

        def spy(half, *args):
            events.append((name, half.which.start))
            return method(half, *args)

        monkeypatch.setattr(Half, name, spy)

    def policy(t, which, obs, goal):
        events.append(("act", which.start))
        return np.zeros((3, 2))

    with ParallelEnvs(POINTS, 6, 2, in_halves=True) as envs:
        assert [half.which for half in envs.halves] == [slice(0, 3), slice(3, 6)]
        envs.reset(0)
        for name in ("wait", "step"):
            noted(name)
        run.rollout(envs, policy, 4)
    turn = [(name, start) for start in (0, 3) for name in ("wait", "act", "step")]
    assert events == 4 * turn + [("wait", 0), ("wait", 3)]


def test_a_process_ends_though_half_of_its_answer_has_been_read(monkeypatch):
    handlers = []  # of this process: a worker that ignores Ctrl-C notes that in a copy
    monkeypatch.setattr(signal, "signal", lambda *args: handlers.append(args))
    with pytest.raises(ZeroDivisionError), ParallelEnvs(POINTS, 4, 2) as envs:
        envs.reset(0)
        vector = envs.halves[0]._env
        process, pipe = vector.processes[0], vector.parent_pipes[0]
        vector.step_async(np.zeros((2, 2, 2)))
        assert len(os.read(pipe.fileno(), 4)) == 4  # the answer's length
        raise ZeroDivisionError
    assert not process.is_alive() and not handlers


@pytest.mark.parametrize("name", ["FetchPush-v1", "HandReach-v0", "HandManipulateEggFull-v0"])
def test_reading_joints_by_index_changes_nothing(name):
    plain, quick = make_env(name), read_joints_by_index(make_env(name))
    assert plain.unwrapped._utils is not quick.unwrapped._utils
    np.testing.assert_equal(plain.reset(seed=1)[0], quick.reset(seed=1)[0])
    for action in np.random.default_rng(0).uniform(-1, 1, (20, *plain.action_space.shape)):
        np.testing.assert_equal(plain.step(action)[0], quick.step(action)[0])


def test_a_worker_that_dies_is_reported():
    with pytest.raises(ChildProcessError, match=r"worker process of Reacher-v2 .*-9"):
        with ParallelEnvs("Reacher-v2", 4, 2) as envs:
            envs.reset(0)
            os.kill(envs.halves[0]._env.processes[1].pid, signal.SIGKILL)
            run.rollout(envs, lambda t, which, obs, goal: np.zeros((4, 2)), 3)
