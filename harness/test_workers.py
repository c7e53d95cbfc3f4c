"""Tests of the environments in their processes."""

import os
import signal
import time

import numpy as np
import pytest

import run
from harness.tasks import make_env
from harness.testing import random_agent
from harness.workers import ParallelEnvs, read_joints_by_index, whole_heads

POINTS = "PointMassEmptyEnv-v1"


@pytest.mark.parametrize(
    ("name", "sizes"), [("FetchReach-v1", (10, 3, 4)), ("PointMassWallEnv-v1", (2, 2, 2))]
)
def test_workers_play_the_same_as_one_process(name, sizes):
    """With the same seeds; a product of fewer rows may round otherwise (NOTES.md)."""
    agent, played = random_agent(2, 0, *sizes), []
    for workers in (1, 2, 4):
        with ParallelEnvs(name, 4, workers) as envs:
            assert envs.num_workers == workers
            envs.reset(7)
            noise = run.exploration(np.random.default_rng(0), (5, 4, sizes[2]), 0.2, 0.3)
            played.append(run.rollout(envs, run.acting_heads(agent, 2, 4, noise), 5)[0])
    for key, array in played[0].items():
        for other in (played[1][key], played[2][key]):
            np.testing.assert_allclose(other, array, atol=1e-4)
            if key != "action":
                np.testing.assert_array_equal(other[:, 0], array[:, 0])
        assert len({row.tobytes() for row in array}) == 4  # each environment has its own seed
        assert array.dtype == np.float32


def test_workers_hold_whole_heads_or_a_part_of_one(monkeypatch):
    for heads, num_envs, asked, made in (
        (16, 16, 5, 4),
        (3, 18, 2, 1),
        (3, 18, 9, 9),
        (1, 16, 3, 2),
    ):
        assert whole_heads(asked, num_envs, heads) == made
    for cores, workers in ((1, 1), (2, 2), (3, 2), (4, 4), (16, 4)):  # many do not make many
        monkeypatch.setattr("harness.workers.available_cores", lambda n=cores: [*range(n)])
        assert whole_heads(None, 16, 16) == workers and whole_heads(16, 16, 16) == 16


def test_workers_share_the_environments_evenly():
    with ParallelEnvs(POINTS, 18, 3) as envs:
        assert [worker.which for worker in envs.workers] == [slice(i, i + 6) for i in (0, 6, 12)]
    with pytest.raises(ValueError, match="4 workers cannot share 18"):
        ParallelEnvs(POINTS, 18, 4)


def test_no_worker_waits_for_another():
    """While one is slow, the other plays on to the end."""
    order = []

    def policy(t, which, obs, goal):
        time.sleep(0.02 if which.start == 0 else 0)
        order.append(which.start)
        return np.zeros((2, 2))

    with ParallelEnvs(POINTS, 4, 2) as envs:
        envs.reset(0)
        run.rollout(envs, policy, 20)
    assert order.count(0) == order.count(2) == 20 and order[:20].count(2) > 15


def test_a_process_ends_though_a_thread_has_read_half_of_its_answer():
    with pytest.raises(ZeroDivisionError), ParallelEnvs(POINTS, 4, 2) as envs:
        envs.reset(0)
        vector = envs.workers[0]._env
        (process,), (pipe,) = vector.processes, vector.parent_pipes
        vector.step_async(np.zeros((1, 2, 2)))
        assert len(os.read(pipe.fileno(), 4)) == 4  # the answer's length
        raise ZeroDivisionError
    assert not process.is_alive()


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinities on this system")
def test_workers_have_a_core_each_and_the_main_process_keeps_all():
    cores, ctrl_c = os.sched_getaffinity(0), signal.getsignal(signal.SIGINT)
    with ParallelEnvs(POINTS, 4 * len(cores), len(cores)) as envs:
        envs.reset(0)
        processes = [process for worker in envs.workers for process in worker._processes()]
        owned = [os.sched_getaffinity(process.pid) for process in processes]
        assert sorted(owned, key=min) == [{core} for core in sorted(cores)] or len(cores) == 1
    assert os.sched_getaffinity(0) == cores and signal.getsignal(signal.SIGINT) == ctrl_c


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
            os.kill(envs.workers[1]._env.processes[0].pid, signal.SIGKILL)
            run.rollout(envs, lambda t, which, obs, goal: np.zeros((2, 2)), 3)
