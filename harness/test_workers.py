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


@pytest.mark.parametrize("name", ["FetchReach-v1", "PointMassWallEnv-v1"])
def test_workers_play_the_same_as_one_process(name):
    played = []
    env = make_env(name)
    obs_dim, goal_dim = (env.observation_space[k].shape[0] for k in ("observation", "desired_goal"))
    action_dim = env.action_space.shape[0]
    agent = random_agent(num_heads=4, obs_dim=obs_dim, goal_dim=goal_dim, action_dim=action_dim)
    for workers in (1, 2, 4):
        with ParallelEnvs(name, 8, workers) as envs:
            assert envs.num_workers == workers
            envs.reset(7)
            rng = np.random.default_rng(0)
            noise = run.exploration(rng, (5, 8, action_dim), 0.2, 0.3)
            policy = run.acting_heads(agent, 4, 8, noise)
            episodes, _ = run.rollout(envs, policy, 5)
            played.append(episodes)
    for key, array in played[0].items():
        for others in (played[1][key], played[2][key]):
            # the same seeds; a product of fewer rows may round otherwise (NOTES.md)
            first = (slice(None), 0) if array.ndim == 3 and key != "action" else ()
            np.testing.assert_allclose(array, others, atol=1e-4)
            if key != "action":
                np.testing.assert_array_equal(array[first], others[first])
        assert len({row.tobytes() for row in array}) == 8  # each environment has its own seed
        assert array.dtype == np.float32


def test_workers_hold_whole_heads_or_a_part_of_one():
    for heads, num_envs, asked, made in (
        (16, 16, 5, 4),
        (3, 18, 2, 1),
        (3, 18, 9, 9),
        (1, 16, 3, 2),
    ):
        with ParallelEnvs(
            "PointMassEmptyEnv-v1", num_envs, whole_heads(asked, num_envs, heads)
        ) as envs:
            assert envs.num_workers == made
            rows = [np.arange(num_envs)[worker.which] for worker in envs.workers]
            np.testing.assert_array_equal(np.concatenate(rows), np.arange(num_envs))


def test_many_cores_do_not_make_many_workers(monkeypatch):
    for cores, workers in ((1, 1), (2, 2), (3, 2), (4, 4), (16, 4)):
        monkeypatch.setattr("harness.workers.available_cores", lambda n=cores: [*range(n)])
        assert whole_heads(None, 16, 16) == workers
        assert whole_heads(16, 16, 16) == 16


def test_no_worker_waits_for_another():
    """While one is slow, the other plays on to the end."""
    order = []

    def policy(t, rows, obs, goal):
        if rows.start == 0:
            time.sleep(0.02)
        order.append(rows.start)
        return np.zeros((2, 2))

    with ParallelEnvs("PointMassEmptyEnv-v1", 4, 2) as envs:
        envs.reset(0)
        run.rollout(envs, policy, 20)
    assert order.count(0) == order.count(2) == 20
    assert order[:20].count(2) > 15


def test_a_process_ends_though_a_thread_has_read_half_of_its_answer():
    with pytest.raises(ZeroDivisionError), ParallelEnvs("PointMassEmptyEnv-v1", 4, 2) as envs:
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
    with ParallelEnvs("PointMassEmptyEnv-v1", 4 * len(cores), len(cores)) as envs:
        several = len(cores) > 1
        pids = [p.pid for w in envs.workers for p in w._env.processes] if several else []
        envs.reset(0)
        owned = [os.sched_getaffinity(pid) for pid in pids]
        assert sorted(core for cores_of in owned for core in cores_of) == sorted(cores) or not pids
    assert os.sched_getaffinity(0) == cores and signal.getsignal(signal.SIGINT) == ctrl_c


@pytest.mark.parametrize("name", ["FetchPush-v1", "HandReach-v0", "HandManipulateEggFull-v0"])
def test_reading_joints_by_index_changes_nothing(name):
    plain, quick = make_env(name), read_joints_by_index(make_env(name))
    assert plain.unwrapped._utils is not quick.unwrapped._utils
    actions = np.random.default_rng(0).uniform(-1, 1, (20, *plain.action_space.shape))
    pairs = [(plain.reset(seed=1)[0], quick.reset(seed=1)[0])]
    pairs += [(plain.step(a)[0], quick.step(a)[0]) for a in actions]
    for a, b in pairs:
        for key in a:
            np.testing.assert_array_equal(a[key], b[key])


def test_a_worker_that_dies_is_reported():
    with pytest.raises(ChildProcessError, match=r"worker process of Reacher-v2 .*-9"):
        with ParallelEnvs("Reacher-v2", 4, 2) as envs:
            envs.reset(0)
            os.kill(envs.workers[1]._env.processes[0].pid, signal.SIGKILL)
            run.rollout(envs, lambda t, rows, obs, goal: np.zeros((2, 2)), 3)
