"""Tests of the environments in their processes."""

import os
import signal
import time

import gymnasium as gym
import numpy as np
import pytest

import run
from envs_point import PointMass
from harness.tasks import make_env
from harness.testing import random_agent
from harness.workers import ParallelEnvs, number_of_workers, read_joints_by_index


@pytest.mark.parametrize("name", ["FetchReach-v1", "PointMassWallEnv-v1"])
def test_workers_play_the_same_as_one_process(name):
    played = []
    env = make_env(name)
    obs_dim, goal_dim = (env.observation_space[k].shape[0] for k in ("observation", "desired_goal"))
    action_dim = env.action_space.shape[0]
    agent = random_agent(num_heads=4, obs_dim=obs_dim, goal_dim=goal_dim, action_dim=action_dim)
    for workers in (1, 2, 4):
        with ParallelEnvs(name, 8, workers, in_halves=workers > 1) as envs:
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


def test_the_environments_are_shared_evenly(monkeypatch):
    for num_envs, asked, made in ((16, 5, 4), (18, 4, 3), (18, 9, 9), (16, 99, 16), (3, 2, 1)):
        assert number_of_workers(asked, num_envs) == made
    for cores, made in ((1, 1), (2, 2), (3, 2), (16, 16), (64, 16)):
        monkeypatch.setattr("harness.workers.available_cores", lambda n=cores: [*range(n)])
        assert number_of_workers(None, 16) == made
    for workers, in_halves, rows in ((1, False, [6]), (3, False, [6]), (2, True, [3, 3])):
        with ParallelEnvs("PointMassEmptyEnv-v1", 6, workers, in_halves) as envs:
            which = [np.arange(6)[half.which] for half in envs.halves]
            assert [len(part) for part in which] == rows
            np.testing.assert_array_equal(np.concatenate(which), np.arange(6))


def test_one_half_acts_while_the_other_steps():
    """20 steps of 10 ms, in which the networks need 10 ms for each half, take no 600 ms."""

    class Slow(PointMass):
        def step(self, action):
            time.sleep(0.01)
            return super().step(action)

    def policy(t, which, obs, goal):
        time.sleep(0.01)
        return np.zeros((1, 2))

    gym.register("Slow-v0", Slow, max_episode_steps=50)
    with ParallelEnvs("Slow-v0", 2, 2, in_halves=True) as envs:
        envs.reset(0)
        run.rollout(envs, policy, 2)
        began = time.perf_counter()
        run.rollout(envs, policy, 20)
    assert time.perf_counter() - began < 0.53


def test_a_process_ends_though_half_of_its_answer_has_been_read():
    with pytest.raises(ZeroDivisionError), ParallelEnvs("PointMassEmptyEnv-v1", 4, 2) as envs:
        envs.reset(0)
        vector = envs.halves[0]._env
        process, pipe = vector.processes[0], vector.parent_pipes[0]
        vector.step_async(np.zeros((2, 2, 2)))
        assert len(os.read(pipe.fileno(), 4)) == 4  # the answer's length
        raise ZeroDivisionError
    assert not process.is_alive()


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinities on this system")
def test_workers_have_a_core_each_and_the_main_process_keeps_all():
    cores, ctrl_c = os.sched_getaffinity(0), signal.getsignal(signal.SIGINT)
    with ParallelEnvs("PointMassEmptyEnv-v1", 4 * len(cores), len(cores)) as envs:
        several = len(cores) > 1
        pids = [p.pid for half in envs.halves for p in half._env.processes] if several else []
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
            os.kill(envs.halves[0]._env.processes[1].pid, signal.SIGKILL)
            run.rollout(envs, lambda t, which, obs, goal: np.zeros((4, 2)), 3)
