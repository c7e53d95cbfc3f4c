"""Tests of the core, in the order of its files: vcp, her, ensemble, envs_point, run.

The ones marked slow train something: leave them out with  pytest -m "not slow".
Where there is a formula, the expected value comes from a slow and obvious version of it in here.
"""

import copy
import itertools
import math
import re
import threading
import timeit
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal, localcontext
from fractions import Fraction
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import nn

import envs_point
import run
from ensemble import HIDDEN, EnsembleDDPG, MultiHeadMLP, Normalizer
from envs_point import CLEARANCE, REACH
from harness import assemble
from harness.records import COLUMNS
from harness.tasks import make_env
from harness.testing import (
    SMALL_TRAINING,
    assert_frequencies,
    exact_reward,
    numbered_episodes,
    random_agent,
    without_timing,
)
from harness.workers import ParallelEnvs
from her import EpisodeBuffer, relabel_future
from run import Config, train
from vcp import HERBuffer, score, update_her_buffer, value_consistency_priority

# ---------------------------------------------------------------------------------- vcp


def test_priority_of_three_transitions_by_hand():
    # σ²_max - σ² + ε with ε = 1: 4, 3, 1; squared: 16, 9, 1
    p = value_consistency_priority(np.array([0.0, 1.0, 3.0]), temperature=2, eps=1.0)
    np.testing.assert_allclose(p, np.array([16, 9, 1]) / 26, rtol=1e-14)


@pytest.mark.parametrize("temperature", [1, 5, 9, 11, 15, 0.5])
def test_priority_is_eq_4_to_the_letter(temperature):
    variance = np.random.default_rng(0).exponential(size=50) ** 3
    with localcontext() as exact:
        exact.prec = 80
        sigma2, eps = [Decimal(float(v)) for v in variance], Decimal("1e-6")
        denominator = sum(max(sigma2) - s + eps for s in sigma2)
        p = [((max(sigma2) - s + eps) / denominator) ** Decimal(temperature) for s in sigma2]
        expected = [float(x / sum(p)) for x in p]
    np.testing.assert_allclose(
        value_consistency_priority(variance, temperature), expected, rtol=1e-9
    )


def test_priority_at_the_extremes():
    # Eq. (4) as it is printed raises about 1/N to the power 𝒯: 163840^-15 is 1e-78, and the largest
    # variance's share (1e-6 / 1e2 / N)^15 is 1e-198.
    variance = np.random.default_rng(0).exponential(size=163_840) ** 2
    for temperature in (15, 30):
        p = value_consistency_priority(variance.astype(np.float32), temperature)
        assert p.dtype == np.float64 and np.all(p > 0) and abs(p.sum() - 1) < 1e-12
        order = np.argsort(variance.astype(np.float32), kind="stable")
        assert np.all(np.diff(p[order]) <= 0)
    np.testing.assert_allclose(value_consistency_priority(np.full(7, 3.0), 9), 1 / 7, rtol=1e-14)
    assert value_consistency_priority(np.array([2.0]), 9).tolist() == [1.0]
    for bad in ([1.0, math.nan], [math.inf, 0.0]):
        with pytest.raises(FloatingPointError):
            value_consistency_priority(np.array(bad), 9)


@given(
    variance=arrays(np.float64, st.integers(1, 50), elements=st.floats(0, 1e4)),
    temperature=st.floats(0.5, 30),
)
def test_any_variances_give_probabilities_in_their_opposite_order(variance, temperature):
    p = value_consistency_priority(variance, temperature)
    assert np.all(p >= 0) and abs(p.sum() - 1) < 1e-9
    assert np.all(np.diff(p[np.argsort(variance)]) <= 0)
    assert p[variance == variance.min()].min() >= 1 / len(p) - 1e-9


def transitions(values, obs_dim=2):
    """A mini-batch whose rows are told apart by `values`."""
    values = np.asarray(values, dtype=np.float32)
    return {
        "obs": np.repeat(values[:, None], obs_dim, axis=1),
        "hindsight": values % 2 == 0,
    }


def test_her_buffer_is_first_in_first_out():
    buffer = HERBuffer(5, temperature=1)
    for first in range(0, 12, 3):  # 0 1 2 | 3 4 5 | 6 7 8 | 9 10 11
        values = np.arange(first, first + 3)
        buffer.add(transitions(values), values.astype(float))
    assert buffer.size == 5
    kept = {float(x) for x in buffer.data["obs"][:, 0]}
    assert kept == {7, 8, 9, 10, 11}
    np.testing.assert_array_equal(buffer.data["variance"], buffer.data["obs"][:, 0])
    np.testing.assert_array_equal(buffer.data["hindsight"], buffer.data["obs"][:, 0] % 2 == 0)
    with pytest.raises(ValueError):
        buffer.add(transitions(range(6)), np.zeros(6))


def test_her_buffer_refuses_what_it_cannot_use():
    """A variance for each head instead of one for each transition, draws without priorities."""
    buffer, rng = HERBuffer(8, temperature=1), np.random.default_rng(0)
    for variance in (np.zeros((3, 1)), np.zeros(2), np.float64(1)):
        with pytest.raises(ValueError, match="one number for each transition"):
            buffer.add(transitions(range(3)), variance)
    for values in ([0, 1, 2], [3, 4]):  # at first, and after new ones came
        batch = {name: torch.from_numpy(x) for name, x in transitions(values).items()}
        buffer.add(batch, torch.arange(float(len(values))))
        with pytest.raises(ValueError, match="call update_priorities"):
            buffer.sample(4, rng)
        buffer.update_priorities()
        assert buffer.sample(4, rng)["obs"].shape == (4, 2)
    np.testing.assert_array_equal(buffer.data["variance"][:5], [0, 1, 2, 0, 1])


@pytest.mark.parametrize("priority", ["consistency", "variance", "uniform", "within-kind"])
def test_sampling_follows_the_priorities(priority):
    variance = np.array([0.0, 0.1, 0.2, 0.5, 0.9, 1.0])
    buffer = HERBuffer(6, temperature=3, priority=priority)
    buffer.add({**transitions(range(6)), "hindsight": np.arange(6) % 3 != 0}, variance)
    buffer.update_priorities()
    x = {
        "consistency": 1 - variance,
        "variance": variance,
        "uniform": np.ones(6),
        "within-kind": np.array([0.5, 0.9, 0.8, 0, 0.1, 0]),  # of originals 0 and 3, and the others
    }[priority] + 1e-6
    expected = x**3 / np.sum(x**3)
    if priority == "within-kind":
        originals, hindsight = x[[0, 3]] ** 3, x[[1, 2, 4, 5]] ** 3
        expected[[0, 3]] = 2 / 6 * originals / originals.sum()
        expected[[1, 2, 4, 5]] = 4 / 6 * hindsight / hindsight.sum()
    np.testing.assert_allclose(buffer.probabilities, expected, rtol=1e-12)
    drawn = buffer.sample(200_000, np.random.default_rng(0))["obs"][:, 0].astype(int)
    counts = np.bincount(drawn, minlength=6)
    rare = expected < 1e-9
    assert counts[rare].sum() == 0
    assert_frequencies(counts[~rare], expected[~rare] / expected[~rare].sum())


@pytest.mark.parametrize("hindsight", [[True, False] * 3, [True] * 6, [False] * 6], ids=str)
def test_weights_within_a_kind_count_no_kind_a_second_time(hindsight):
    """Each kind has the weight of its draws; within it, w is p."""
    kind, variance = np.array(hindsight), np.array([0.0, 5.0, 0.1, 9.0, 0.2, 7.0])
    buffer = HERBuffer(6, temperature=2, priority="within-kind")
    buffer.add({**transitions(range(6)), "hindsight": kind}, variance)
    buffer.update_priorities()
    batch = buffer.sample(400, np.random.default_rng(0))
    p = buffer.probabilities[batch["obs"][:, 0].astype(int)]
    for of_the_kind in (batch["hindsight"], ~batch["hindsight"]):
        if of_the_kind.any():
            expected = p[of_the_kind] / p[of_the_kind].mean()
            np.testing.assert_allclose(batch["weight"][of_the_kind], expected, rtol=1e-6)
    assert abs(buffer.probabilities[kind].sum() - kind.mean()) < 1e-12


def test_sampling_is_right_for_every_random_number():
    buffer = HERBuffer(3, temperature=1, priority="consistency")
    buffer.add(transitions([0, 1, 2]), np.array([2.0, 4.0, 2.0]))
    buffer.update_priorities()

    class Edge:  # the smallest and the largest that a Generator's random() gives, and p_1
        def random(self, size):
            return np.array([0.0, np.nextafter(1, 0), buffer.probabilities[0]])[:size]

    assert buffer.sample(3, Edge())["obs"][:, 0].tolist() == [0, 2, 1]


@pytest.mark.parametrize("importance", ["paper", "inverse", "none"])
def test_importance_weights(importance):
    buffer = HERBuffer(4, temperature=2, importance=importance)
    buffer.add(transitions(range(4)), np.array([0.0, 1.0, 2.0, 2.5]))
    buffer.update_priorities()
    batch = buffer.sample(64, np.random.default_rng(0))
    p = buffer.probabilities[batch["obs"][:, 0].astype(int)]
    w = {"paper": p, "inverse": 1 / p, "none": np.ones(64)}[importance]
    np.testing.assert_allclose(batch["weight"], w / w.mean(), rtol=1e-6)


@given(
    capacity=st.integers(1, 12),
    sizes=st.lists(st.integers(1, 12), min_size=1, max_size=8),
    temperature=st.floats(0.5, 30),
)
def test_any_ring_keeps_the_newest_and_draws_only_those(capacity, sizes, temperature):
    buffer, stored = HERBuffer(capacity, temperature), []
    for size in sizes:
        values = np.arange(len(stored), len(stored) + min(size, capacity))
        buffer.add(transitions(values), values % 5 * 0.1)
        stored += values.tolist()
    kept = stored[-capacity:]
    assert buffer.size == len(kept)
    assert sorted(buffer.data["obs"][: buffer.size, 0]) == kept
    buffer.update_priorities()
    batch = buffer.sample(20, np.random.default_rng(0))
    assert set(batch["obs"][:, 0]) <= set(kept)
    assert abs(batch["weight"].mean() - 1) < 1e-5
    again = HERBuffer(capacity, temperature)
    again.load_state_dict(copy.deepcopy(buffer.state_dict()))
    for b in (buffer, again):
        b.add(transitions([1000]), np.array([0.0]))
        b.update_priorities()
    np.testing.assert_array_equal(again.probabilities, buffer.probabilities)
    for name, rows in buffer.data.items():
        np.testing.assert_array_equal(again.data[name][: buffer.size], rows[: buffer.size])


def test_algorithm_1_scores_and_stores_what_it_drew():
    original = EpisodeBuffer(200, 50, 2, 2, 2, 0.8, exact_reward)
    original.add(numbered_episodes(), np.random.default_rng(0))
    agent = EnsembleDDPG(2, 2, 2, gamma=0.98, num_heads=4)
    buffer = HERBuffer(100, temperature=9)
    for _ in range(2):
        update_her_buffer(buffer, original, agent.q_variance, 40, np.random.default_rng(1))
    assert buffer.size == 80
    rows = {name: x[:80] for name, x in buffer.data.items()}
    expected = agent.q_variance(rows["obs"], rows["action"], rows["goal"])
    np.testing.assert_allclose(rows["variance"], expected, rtol=1e-5)
    np.testing.assert_allclose(
        buffer.probabilities, value_consistency_priority(rows["variance"], 9), rtol=1e-12
    )


# ---------------------------------------------------------------------------------- her


def test_episode_buffer_fills_then_overwrites_random_episodes():
    rng = np.random.default_rng(0)
    buffer = EpisodeBuffer(5 * 3 + 2, 3, 2, 2, 2, 0.8, exact_reward)
    episodes = numbered_episodes(9, horizon=3)

    def some(*which):
        return {name: x[list(which)] for name, x in episodes.items()}

    buffer.add(some(0, 1), rng)
    assert buffer.size == 2 and len(buffer.episodes["obs"]) == 2
    buffer.add(some(2, 3, 4), rng)
    np.testing.assert_array_equal(buffer.episodes["achieved_goal"], episodes["achieved_goal"][:5])
    overwritten = set()
    for _ in range(50):
        buffer.add(some(5, 6), rng)
        ids = buffer.episodes["achieved_goal"][:, 0, 0]
        assert buffer.size == 5 and {5, 6} <= set(ids.tolist())
        np.testing.assert_array_equal(buffer.episodes["action"][:, 0, 0], -ids)
        overwritten |= set(np.flatnonzero(ids >= 5).tolist())
    assert overwritten == set(range(5))
    with pytest.raises(ValueError):
        buffer.add({name: x[:6] for name, x in episodes.items()}, rng)
    with pytest.raises(ValueError):
        EpisodeBuffer(49, 50, 2, 2, 2, 0.8, exact_reward)


def test_episodes_of_other_shapes_are_refused_by_name():
    buffer, episodes = EpisodeBuffer(200, 50, 2, 2, 2, 0.8, exact_reward), numbered_episodes(3)
    for name, wrong in (
        ("obs", episodes["obs"][:, 1:]),
        ("achieved_goal", episodes["achieved_goal"][0]),
        ("desired_goal", episodes["desired_goal"][:, :1]),
        ("action", episodes["action"][..., None]),
        ("desired_goal", episodes["desired_goal"][:2]),
    ):
        with pytest.raises(ValueError, match=re.escape(f'episodes["{name}"] is {wrong.shape}')):
            buffer.add({**episodes, name: wrong}, np.random.default_rng(0))
    one = {name: x[0] for name, x in episodes.items()}  # without its first axis
    with pytest.raises(ValueError, match=r"is \(51, 2\), and must be \(50, 51, 2\)"):
        buffer.add(one, np.random.default_rng(0))
    assert buffer.size == 0


@pytest.mark.parametrize(
    ("reward_fn", "error", "message"),
    [
        (lambda a, d: np.where(a[:, 0] > 2, np.nan, -1), FloatingPointError, "in the rewards"),
        (lambda a, d: 1.0 * (a == d).all(axis=-1), ValueError, "reward_fn gave 0.0 to 1.0"),
        (lambda a, d: -np.abs(a - d).sum(axis=-1), ValueError, "not Eq. \\(1\\)'s -1 and 0"),
        (lambda a, d: -np.linalg.norm(a - d), ValueError, r"gave \(\), not \(500,\) rewards"),
        (lambda a, d: -1.0 * (a != d), ValueError, r"of \(500, 2\) goals gave \(500, 2\)"),
    ],
)
def test_rewards_that_are_not_eq_1_are_refused(reward_fn, error, message):
    with pytest.raises(error, match=message):
        relabel_future(numbered_episodes(), 500, np.random.default_rng(0), 0.8, reward_fn)


@given(capacity=st.integers(1, 60), horizon=st.integers(1, 20), adds=st.lists(st.integers(1, 5)))
def test_any_episode_buffer_holds_whole_episodes(capacity, horizon, adds):
    if capacity < horizon:
        with pytest.raises(ValueError):
            EpisodeBuffer(capacity, horizon, 2, 2, 2, 0.8, exact_reward)
        return
    buffer, added = EpisodeBuffer(capacity, horizon, 2, 2, 2, 0.8, exact_reward), 0
    episodes = numbered_episodes(len(adds) * 5 + 1, horizon)
    for new in adds:
        if new > buffer.capacity:
            continue
        some = {name: x[added : added + new] for name, x in episodes.items()}
        buffer.add(some, np.random.default_rng(added))
        added += new
        ids = buffer.episodes["achieved_goal"][:, 0, 0].astype(int)
        assert buffer.size == min(added, buffer.capacity) == len(set(ids))
        assert set(range(added - new, added)) <= set(ids)
        for name, x in buffer.episodes.items():
            np.testing.assert_array_equal(x, episodes[name][ids])


def test_future_relabelling_draws_later_steps_of_the_same_episode():
    horizon, n = 50, 4
    episodes = numbered_episodes(n, horizon)
    batch = relabel_future(episodes, 400_000, np.random.default_rng(0), 0.8, exact_reward)
    e, t = (batch["obs"] / 10).astype(int).T
    relabelled = batch["goal"][:, 0] >= 0
    np.testing.assert_array_equal(batch["hindsight"], relabelled)
    np.testing.assert_array_equal(batch["action"], -batch["obs"] / 10)
    np.testing.assert_array_equal(batch["next_obs"] - batch["obs"], [[0, 10]] * len(e))
    np.testing.assert_array_equal(batch["goal"][~relabelled], -1 - e[~relabelled, None] * [1, 1])

    # 80 % relabelled, 20 % original, whatever the episode and step
    assert abs(relabelled.mean() - 0.8) < 5 * math.sqrt(0.16 / len(e))
    assert_frequencies(np.bincount(e * horizon + t), np.full(n * horizon, 1 / (n * horizon)))

    goal_episode, future = batch["goal"][relabelled].astype(int).T
    np.testing.assert_array_equal(goal_episode, e[relabelled])
    offset = future - t[relabelled]
    # P(offset = j) = 1/T Σ_{t: T-t >= j} 1/(T-t), j = 1..T
    expected = [
        sum(Fraction(1, horizon - s) for s in range(horizon) if horizon - s >= j) / horizon
        for j in range(1, horizon + 1)
    ]
    assert_frequencies(np.bincount(offset, minlength=horizon + 1)[1:], [float(p) for p in expected])
    assert abs(float(expected[0]) - 0.08998) < 5e-6  # the goal is the own next state
    assert float(sum(j * p for j, p in enumerate(expected, 1))) == 13.25
    # given t, uniform over t+1..T
    last = t[relabelled] == horizon - 3
    counts = np.bincount(future[last], minlength=horizon + 1)[horizon - 2 :]
    assert_frequencies(counts, np.full(3, 1 / 3))

    # the reward is 0 exactly where the goal is the NEXT achieved goal
    np.testing.assert_array_equal(batch["reward"][relabelled], np.where(offset == 1, 0.0, -1.0))
    np.testing.assert_array_equal(batch["reward"][~relabelled], -1)


@given(
    n=st.integers(1, 6),
    horizon=st.integers(1, 12),
    size=st.integers(1, 50),
    ratio=st.floats(0, 1),
    seed=st.integers(0, 2**32 - 1),
)
def test_relabelling_of_any_episodes(n, horizon, size, ratio, seed):
    rng = np.random.default_rng(seed)
    batch = relabel_future(numbered_episodes(n, horizon), size, rng, ratio, exact_reward)
    e, t = (batch["obs"] / 10).astype(int).T
    assert np.all((0 <= e) & (e < n) & (0 <= t) & (t < horizon))
    relabelled = batch["hindsight"]
    goal_episode, future = batch["goal"].T
    assert np.all(goal_episode[relabelled] == e[relabelled])
    assert np.all((t < future)[relabelled] & (future <= horizon)[relabelled])
    assert np.all(batch["goal"][~relabelled].T == -1 - e[~relabelled])  # the episode's own
    reached = (batch["next_obs"] == 10 * batch["goal"]).all(axis=1)
    np.testing.assert_array_equal(batch["reward"], reached - 1.0)


def test_relabel_ratio_zero_and_one():
    for ratio in (0.0, 1.0):
        batch = relabel_future(
            numbered_episodes(), 1000, np.random.default_rng(0), ratio, exact_reward
        )
        assert np.all(batch["hindsight"] == bool(ratio))


@pytest.mark.parametrize("name", ["FetchReach-v1", "HandManipulateBlockRotateZ-v0", "Reacher-v2"])
def test_recomputed_rewards_are_the_environments_own(name):
    env = make_env(name)
    rng = np.random.default_rng(0)
    rewards, achieved, goals = [], [], []
    for seed in range(6):
        obs, _ = env.reset(seed=seed)
        for _ in range(20):
            obs, reward, *_ = env.step(rng.uniform(-1, 1, env.action_space.shape))
            rewards.append(reward)
            achieved.append(obs["achieved_goal"])
            goals.append(obs["desired_goal"])
    achieved, goals = np.float32(achieved), np.float32(goals)  # as B_o stores them
    np.testing.assert_array_equal(env.unwrapped.compute_reward(achieved, goals, {}), rewards)


# ---------------------------------------------------------------------------------- ensemble


class PlainHead(nn.Module):
    """One head's actor or critic as anyone would write it, with a trunk that may be shared."""

    def __init__(self, params, trunk=None, is_actor=False):
        super().__init__()
        w1, b1, w2, b2, w3, b3, w4, b4 = params
        end = [nn.Tanh()] if is_actor else []
        layers = [self.layer(w1, b1), nn.ReLU(), self.layer(w2, b2), nn.ReLU()]
        self.trunk = trunk or nn.Sequential(*layers)
        self.head = nn.Sequential(self.layer(w3, b3), nn.ReLU(), self.layer(w4, b4), *end)

    @staticmethod
    def layer(w, b):
        linear = nn.Linear(*w.T.shape)
        with torch.no_grad():
            linear.weight.copy_(w)
            linear.bias.copy_(b)
        return linear

    def forward(self, *x):
        return self.head(self.trunk(torch.cat(x, dim=-1)))


def plain_ensemble(net, is_actor):
    """K PlainHeads that share one trunk, with the values of a MultiHeadMLP."""
    heads, trunk = [], None
    for k in range(len(net.stacks[0])):
        heads.append(PlainHead([*net.trunk, *net.own[k]], trunk, is_actor))
        trunk = heads[-1].trunk
    return heads


def random_batch(n=32, obs_dim=5, goal_dim=3, action_dim=2, seed=0):
    rng = np.random.default_rng(seed)
    return {
        "obs": rng.normal(size=(n, obs_dim)),
        "action": rng.uniform(-1, 1, (n, action_dim)),
        "next_obs": rng.normal(size=(n, obs_dim)),
        "goal": rng.normal(size=(n, goal_dim)),
        "reward": -rng.integers(0, 2, n).astype(float),
        "weight": rng.uniform(0.5, 1.5, n),
    }


def as_tensors(agent, batch):
    """obs|goal and next_obs|goal, normalised, then action, reward (B, 1) and weight (B, 1)."""
    t = {name: torch.as_tensor(x, dtype=torch.float32) for name, x in batch.items()}
    mean, std = agent.normalizer.mean, agent.normalizer.std
    state, next_state = (
        ((torch.cat([t[o], t["goal"]], dim=1) - mean) / std).clamp(-5, 5)
        for o in ("obs", "next_obs")
    )
    return state, next_state, t["action"], t["reward"][:, None], t["weight"][:, None]


def test_the_ensemble_is_16_separate_networks():
    agent = random_agent()
    batch = random_batch()
    state, _, action, *_ = as_tensors(agent, batch)
    actors, critics = plain_ensemble(agent.actor, True), plain_ensemble(agent.critic, False)
    with torch.no_grad():
        # all heads on the same rows
        q = torch.stack([critic(state, action)[:, 0] for critic in critics])
        variance = agent.q_variance(batch["obs"], batch["action"], batch["goal"])
        np.testing.assert_allclose(variance, q.numpy().astype(float).var(axis=0), rtol=1e-3)
        # each head on two rows of its own
        expected = torch.stack([actors[k](state[2 * k : 2 * k + 2]) for k in range(16)])
        obs, goal = batch["obs"].reshape(16, 2, -1), batch["goal"].reshape(16, 2, -1)
        np.testing.assert_allclose(agent.act(obs, goal), expected, atol=1e-5)
        value = [critics[k](state[2 * k : 2 * k + 2], expected[k])[:, 0].numpy() for k in range(16)]
        np.testing.assert_allclose(agent.value(obs, goal), np.stack(value), atol=1e-4)
        # only some heads
        alone = agent.act(batch["obs"][None], batch["goal"][None], slice(1))
        for wrong in (batch["obs"][:16], obs[:2], obs[0], obs[None]):
            with pytest.raises(ValueError, match=re.escape(f"obs is {wrong.shape}")):
                agent.act(wrong, goal)
        np.testing.assert_allclose(alone[0], actors[0](state), atol=1e-5)


def test_networks_have_the_papers_size_and_start_like_their_targets():
    agent = EnsembleDDPG(10, 3, 4, gamma=0.98)
    assert HIDDEN == 256 and agent.num_heads == 16
    assert [tuple(p.shape) for p in [*agent.critic.trunk, *agent.critic.own[3]]] == [
        (256, 17), (256,), (256, 256), (256,), (256, 256), (256,), (1, 256), (1,),
    ]  # fmt: skip
    for net, target in (
        (agent.actor, agent.target_actor),
        (agent.critic, agent.target_critic),
    ):
        for p, q in zip(net.trunk + net.stacks, target.trunk + target.stacks, strict=True):
            assert torch.equal(p, q) and p.data_ptr() != q.data_ptr()
        w = net.stacks[0]
        assert abs(w.std().item() - math.sqrt(2 / 512)) < 1e-3  # Xavier-uniform
        assert not torch.equal(w[0], w[1])
    again = EnsembleDDPG(10, 3, 4, gamma=0.98)
    other = EnsembleDDPG(10, 3, 4, gamma=0.98, seed=1)
    assert torch.equal(agent.actor.stacks[0], again.actor.stacks[0])
    assert not torch.equal(agent.actor.stacks[0], other.actor.stacks[0])


def test_a_head_is_trained_through_its_network_with_any_optimiser():
    """What one copies: `net(k, x)` and `net.parameters()`; `all_heads` sees what was learned."""
    net = MultiHeadMLP(3, 2, 4, torch.Generator().manual_seed(0))
    optimizer = torch.optim.SGD([p.requires_grad_() for p in net.parameters()], lr=0.1)
    x = torch.randn(6, 3, generator=torch.Generator().manual_seed(1))
    before = net.all_heads(x)
    net(2, x).square().mean().backward()
    optimizer.step()
    after = net.all_heads(x)
    torch.testing.assert_close(after[2], net(2, x).detach())
    assert after[2].square().mean() < before[2].square().mean()
    assert not after.requires_grad and not net(2, x, frozen=True).requires_grad
    own = [torch.equal(p, q) for p, q in zip(net.own[0], net.own[2], strict=True)]
    assert len(net.parameters()) == 4 + 4 * 4 and not own[0]


@pytest.mark.parametrize("turns", [[[1], [2], [1], [0], [1]], [[0, 1, 2], [2, 0]]], ids=str)
def test_updates_are_those_of_plain_ddpg(turns):
    """Eqs. (2) and (3), step by step, against plain modules, plain Adam and the textbook's loss:
    own targets, clipping, weights, gradients before steps, one Adam of the trunk for all heads. Of
    heads that step together the trunk's gradients are added up. The gradients themselves are
    compared too, as Adam's step hides their scale."""
    agent = random_agent(num_heads=3, action_penalty=0.3, learning_rate=2e-3)
    actors, critics = plain_ensemble(agent.actor, True), plain_ensemble(agent.critic, False)
    target_actors = plain_ensemble(agent.target_actor, True)
    target_critics = plain_ensemble(agent.target_critic, False)
    trunks = [torch.optim.Adam(nets[0].trunk.parameters(), 2e-3) for nets in (actors, critics)]
    heads = [
        [torch.optim.Adam(nets[k].head.parameters(), 2e-3) for nets in (actors, critics)]
        for k in range(3)
    ]
    assert all(net.trunk is nets[0].trunk for nets in (actors, critics) for net in nets)
    params = [*agent.actor.parameters(), *agent.critic.parameters()]
    gradients = {}  # with which the agent last stepped
    agent.optimizer.register_step_pre_hook(lambda *_: gradients.update({p: p.grad for p in params}))
    batches = (random_batch(seed=i) for i in range(6))
    for together in turns:
        drawn, expected = [next(batches) for _ in together], []
        for k, batch in zip(together, drawn, strict=True):
            state, next_state, action, reward, weight = as_tensors(agent, batch)
            with torch.no_grad():
                y = reward + 0.9 * target_critics[k](next_state, target_actors[k](next_state))
                y = torch.clip(y, -1 / (1 - 0.9), 0)
            critic_loss = (weight * (critics[k](state, action) - y) ** 2).mean()
            pi = actors[k](state)
            actor_loss = -(weight * critics[k](state, pi)).mean() + 0.3 * (weight * pi**2).mean()
            for loss, net in ((critic_loss, critics[k]), (actor_loss, actors[k])):
                params_k = [*net.parameters()]
                gradients_k = torch.autograd.grad(loss, params_k, retain_graph=True)
                for p, g in zip(params_k, gradients_k, strict=True):
                    p.grad = g if p.grad is None else p.grad + g
            expected.append(torch.stack([critic_loss, actor_loss]).detach())
        if len(together) == 1:
            losses = agent.update_head(*together, *drawn)[None]
        else:
            losses = agent.update_heads(together, drawn)
        torch.testing.assert_close(losses, torch.stack(expected), rtol=1e-4, atol=1e-5)
        for plain, net in ((actors, agent.actor), (critics, agent.critic)):
            for k in together:
                own = [gradients[p] for p in (*net.trunk, *net.own[k])]
                expected = [p.grad for p in plain[k].parameters()]
                torch.testing.assert_close(own, expected, rtol=1e-3, atol=1e-5)
        for optimizer in (*trunks, *(adam for k in together for adam in heads[k])):
            optimizer.step()
            optimizer.zero_grad()
    for plain, net in ((actors, agent.actor), (critics, agent.critic)):
        for k in range(3):
            for p, q in zip(plain[k].parameters(), [*net.trunk, *net.own[k]], strict=True):
                torch.testing.assert_close(p, q, rtol=1e-3, atol=3e-5)


def backwards(function, *lists):
    """A `map` whose last call is the first to be done."""
    return reversed([function(*arguments) for arguments in reversed([*zip(*lists, strict=True)])])


def test_any_number_of_threads_gives_the_same_bits():
    """Weights and variances of 1, 2, 3 and 16 threads, and of one that goes backwards."""
    pools = [ThreadPoolExecutor(n) for n in (1, 2, 3, 16)]
    maps = [map, backwards, *(pool.map for pool in pools)]
    rows = [random_batch(n=700)[name] for name in ("obs", "action", "goal")]
    learned = []
    for how in maps:
        agent = random_agent()
        for i in range(3):
            batches = [random_batch(seed=100 * i + k) for k in range(16)]
            losses = agent.update_heads(range(16), batches, how)
        weights = [p.detach() for p in agent.actor.parameters() + agent.critic.parameters()]
        variance = torch.from_numpy(agent.snapshot_q_variance(how)(*rows))
        learned.append([losses, variance, *weights])
    for others in learned[1:]:
        assert all(map(torch.equal, learned[0], others))
    np.testing.assert_allclose(learned[0][1], agent.q_variance(*rows), rtol=1e-3)
    for pool in pools:
        pool.shutdown()
    with pytest.raises(ValueError, match="2 heads and 1 mini-batches"):
        agent.update_heads([0, 1], batches[:1])


def test_update_of_a_head_moves_it_and_the_trunk_and_nothing_else():
    agent = random_agent(num_heads=4)
    nets = (agent.actor, agent.critic, agent.target_actor, agent.target_critic)
    before = [[p.detach().clone() for p in (*net.trunk, *net.stacks)] for net in nets]
    agent.update_head(2, random_batch())
    for i, net in enumerate(nets):
        for p, old in zip((*net.trunk, *net.stacks), before[i], strict=True):
            if i >= 2:  # targets
                assert torch.equal(p, old)
            elif any(p is q for q in net.trunk):
                assert not torch.equal(p, old)
            else:
                changed = [not torch.equal(p[k], old[k]) for k in range(4)]
                assert changed == [False, False, True, False]


def test_targets_are_clipped_to_the_range_of_returns():
    """With targets far outside [-1/(1-γ), 0] = [-10, 0], the loss is that of the bound."""
    batch = random_batch()
    for bias, bound in ((1000.0, 0.0), (-1000.0, -10.0)):
        agent = random_agent(num_heads=2)
        agent.target_critic.stacks[3].fill_(bias)
        state, _, action, _, weight = as_tensors(agent, batch)
        with torch.no_grad():
            q = plain_ensemble(agent.critic, False)[1](state, action)
        loss, _ = agent.update_head(1, batch)
        torch.testing.assert_close(loss, (weight * (q - bound) ** 2).mean(), rtol=1e-4, atol=1e-5)


def test_polyak_moves_the_shared_trunk_once_for_each_head():
    agent = random_agent(num_heads=5, polyak=0.9)
    expected = []
    for target, net in ((agent.target_actor, agent.actor), (agent.target_critic, agent.critic)):
        trunk, heads = copy.deepcopy(target.trunk), copy.deepcopy(target.stacks)
        for k in range(5):  # as it is said: for each head, its trunk and its head
            for p, q in zip(trunk, net.trunk, strict=True):
                p.mul_(0.9).add_(0.1 * q.detach())
            for p, q in zip(heads, net.stacks, strict=True):
                p[k] = 0.9 * p[k] + 0.1 * q[k].detach()
        expected.append((trunk, heads))
    agent.update_targets()
    for target, (trunk, heads) in zip(
        (agent.target_actor, agent.target_critic), expected, strict=True
    ):
        for p, q in zip(target.trunk + target.stacks, trunk + heads, strict=True):
            torch.testing.assert_close(p, q)


def test_normalizer_against_numpy():
    rng = np.random.default_rng(0)
    x = rng.normal([0, 5, -1000, 3], [1, 0.1, 500, 0], (10_000, 4))
    normalizer = Normalizer(4)
    for part in np.array_split(x, 7):
        normalizer.update(part)
    clipped = np.clip(x, -200, 200)
    mean, std = clipped.mean(axis=0), np.maximum(clipped.std(axis=0), 0.01)
    np.testing.assert_allclose(normalizer.mean, mean, rtol=1e-5)
    np.testing.assert_allclose(normalizer.std, std, rtol=1e-4)
    row = torch.tensor([[100.0, 5.05, -1e9, 3.02]])
    expected = np.clip((np.clip(row.numpy(), -200, 200) - mean) / std, -5, 5)
    np.testing.assert_allclose(normalizer(row), expected, rtol=1e-3)
    assert normalizer(row)[0, 0] == 5  # 100 standard deviations


# ---------------------------------------------------------------------------------- envs_point


@pytest.mark.parametrize(
    "name", ["PointMassEmptyEnv-v1", "PointMassWallEnv-v1", "SparseReacher-v1"]
)
def test_our_environments_pass_gymnasiums_checker(name, recwarn):
    env = gym.make(name, disable_env_checker=True).unwrapped
    check_env(env, skip_render_check="Reacher" in name)  # MuJoCo's windows need a display
    # Reacher's spaces are unbounded, as MuJoCo's own are; the checker remarks on that
    own = [w for w in recwarn if "infinity" not in str(w.message)]
    assert not own, [str(w.message) for w in own]


@pytest.mark.parametrize("name", ["PointMassEmptyEnv-v1", "PointMassWallEnv-v1"])
def test_point_mass_renders_and_is_seeded(name):
    env = gym.make(name, render_mode="rgb_array")
    first, _ = env.reset(seed=3)
    picture = env.render()
    assert picture.shape == (360, 360, 3) and picture.dtype == np.uint8
    colours = {tuple(c) for c in picture.reshape(-1, 3).tolist()}
    assert len(colours) == 4  # floor, walls, circle, goal
    # the circle is drawn where it is: rows go down, y goes up
    rows, columns = np.nonzero((picture == (0, 114, 178)).all(axis=-1))
    place = np.array([columns.mean() - 179.5, 179.5 - rows.mean()]) / 360 * 2 * 0.66
    np.testing.assert_allclose(place, first["achieved_goal"], atol=0.02)
    again, _ = env.reset(seed=3)
    other, _ = env.reset()
    np.testing.assert_array_equal(first["desired_goal"], again["desired_goal"])
    assert not np.array_equal(first["desired_goal"], other["desired_goal"])


@pytest.mark.parametrize("name", ["PointMassEmptyEnv-v1", "PointMassWallEnv-v1"])
def test_point_mass_takes_50_000_steps_a_second(name):
    env = make_env(name)
    actions = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)

    def episode():
        env.reset()
        for action in actions:
            env.step(action)

    # the fastest of 200: the others wait for whatever else the machine does
    assert 50 / min(timeit.repeat(episode, number=1, repeat=200)) > 50_000


def distance_to_wall(xy):
    """From points (N, 2) to the wall's axis, the segment from (-inf, 0) to (0.2, 0)."""
    nearest_x = np.minimum(xy[:, 0], 0.2)
    return np.hypot(xy[:, 0] - nearest_x, xy[:, 1])


@pytest.mark.parametrize("wall", [False, True])
def test_point_mass_never_leaves_the_room_or_enters_the_wall(wall):
    """1e6 steps from random starts, by actions that push on (a random walk would rarely touch)."""
    env = envs_point.PointMass(wall=wall)
    rng = np.random.default_rng(0)
    where, goals = np.empty((1_000_000, 2)), []
    for i in range(len(where)):
        if i % 100 == 0:
            obs, _ = env.reset(seed=0 if i == 0 else None)
            goals.append(obs["desired_goal"])
        if i % 5 == 0:
            action = rng.uniform(-1.5, 1.5, 2)  # beyond the bounds too
        where[i] = env.step(action)[0]["achieved_goal"]
    assert np.abs(where).max() <= REACH and np.abs(goals).max() <= REACH
    assert (np.abs(where) == REACH).any()
    if wall:
        assert distance_to_wall(where).min() >= CLEARANCE - 1e-12
        assert distance_to_wall(np.array(goals)).min() >= CLEARANCE
        assert (distance_to_wall(where) < CLEARANCE + 1e-12).sum() > 1000  # it was touched
    moved = np.abs(np.diff(where.reshape(-1, 100, 2), axis=1))
    assert moved.max() <= 0.05 * math.sqrt(2) + 1e-12


def point_mass_at(x, y, wall=True):
    env = envs_point.PointMass(wall=wall)
    env.reset(seed=0)
    env._xy = (x, y)
    return env


def test_the_wall_stops_what_runs_into_it_and_lets_it_slide():
    env = point_mass_at(-0.3, 0.3)
    for _ in range(20):
        obs, *_ = env.step([0, -1])
    np.testing.assert_allclose(obs["observation"], [-0.3, CLEARANCE])
    obs, *_ = env.step([1, -1])  # slides along
    np.testing.assert_allclose(obs["observation"], [-0.25, CLEARANCE])
    obs, *_ = env.step([0, 1])  # and leaves
    np.testing.assert_allclose(obs["observation"], [-0.25, CLEARANCE + 0.05])
    # from below, and against the round end, straight and off its centre
    assert point_mass_at(0.0, -0.1).step([0, 1])[0]["observation"].tolist() == [0.0, -CLEARANCE]
    x, y = point_mass_at(0.3, 0.0).step([-1, 0])[0]["observation"]
    assert (x, y) == pytest.approx((0.2 + CLEARANCE, 0.0))
    x, y = point_mass_at(0.29, 0.03).step([-1, 0])[0]["observation"]
    assert y > 0.03 and math.hypot(x - 0.2, y) >= CLEARANCE - 1e-12
    # the same step in a room without the wall goes through
    assert point_mass_at(0.0, 0.1, wall=False).step([0, -1])[0]["observation"][1] < 0.06


def test_sliding_is_what_many_small_steps_do():
    """`slide_along_wall` solves for the contact; pushing the point out of the wall after each of
    1,000 small steps ends at the same place."""
    rng = np.random.default_rng(0)
    touched = 0
    for _ in range(500):
        x, y = rng.uniform([-0.5, -0.13], [0.33, 0.13])
        if envs_point.inside_wall(x, y):
            continue
        d = rng.uniform(-0.05, 0.05, 2)
        p = np.array([x, y])
        contact = None
        for _ in range(1000):
            step = d / 1000
            if contact is not None:  # after the contact, along the tangent there
                step = step - min(step @ contact, 0) * contact
            p = p + step
            axis = np.array([min(p[0], 0.2), 0.0])
            if contact is None and np.linalg.norm(p - axis) < CLEARANCE:
                contact = (p - axis) / np.linalg.norm(p - axis)
                touched += 1
        expected = envs_point.slide_along_wall(x, y, x + d[0], y + d[1])
        np.testing.assert_allclose(p, expected, atol=2e-4)
    assert touched > 30


def test_every_goal_can_be_reached_within_an_episode():
    """A breadth-first search over a grid of places one step apart, by the environment's own steps:
    from any start to the grid, along it, and so to within 0.05 of any goal, in 50 steps."""
    env = point_mass_at(0, 0.3)
    moves = [np.array(m, dtype=float) for m in itertools.product((-1, 0, 1), repeat=2)]
    axis = [round(-REACH + 0.05 * i, 10) for i in range(23)]
    places = [p for p in itertools.product(axis, axis) if not envs_point.inside_wall(*p)]
    index = {p: i for i, p in enumerate(places)}
    neighbours = []
    for place in places:
        reached = set()
        for move in moves:
            env._xy = place
            obs, *_ = env.step(move)
            end = tuple(round(float(c), 10) for c in obs["achieved_goal"])
            if end in index:  # not where it slid to a stop between places
                reached.add(index[end])
        neighbours.append(reached)
    longest = 0
    for start in range(len(places)):
        distance, frontier, seen = 0, {start}, {start}
        while frontier:
            frontier = set().union(*(neighbours[i] for i in frontier)) - seen
            seen |= frontier
            distance += bool(frontier)
        assert len(seen) == len(places)
        longest = max(longest, distance)
    # Every place where the circle can be is within one step of a place of the grid that it can go
    # to in a straight line, so one step leads there, and the last place is within 0.05 of the goal.
    grid = np.array(places)
    for _ in range(2000):
        point = np.array(env._free_place())
        offsets = grid - point
        close = np.abs(offsets).max(axis=1) <= 0.05
        direct = [
            np.allclose(envs_point.slide_along_wall(*point, *grid[i]), grid[i])
            for i in np.flatnonzero(close)
        ]
        assert any(direct), point
        assert np.linalg.norm(offsets, axis=1).min() <= 0.05, point
    assert longest + 1 <= 50, longest


def test_reacher_reports_the_fingertips_velocity():
    env = gym.make("SparseReacher-v1", disable_env_checker=True).unwrapped
    obs, _ = env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(30):
        obs, reward, *_, info = env.step(rng.uniform(-1, 1, 2))
        cos, sin, tip, velocity = np.split(obs["observation"], 4)
        np.testing.assert_allclose(cos, np.cos(env.data.qpos[:2]))
        np.testing.assert_allclose(sin, np.sin(env.data.qpos[:2]))
        # the geometry of reacher.xml: links of 0.1 and 0.11
        q1, q2 = env.data.qpos[0], env.data.qpos[:2].sum()
        w1, w2 = env.data.qvel[0], env.data.qvel[:2].sum()
        expected = [0.1 * np.cos(q1) + 0.11 * np.cos(q2), 0.1 * np.sin(q1) + 0.11 * np.sin(q2)]
        np.testing.assert_allclose(tip, expected, atol=1e-6)
        expected = [
            -0.1 * np.sin(q1) * w1 - 0.11 * np.sin(q2) * w2,
            0.1 * np.cos(q1) * w1 + 0.11 * np.cos(q2) * w2,
        ]
        np.testing.assert_allclose(velocity, expected, atol=1e-6)
        np.testing.assert_array_equal(tip, obs["achieved_goal"])
        near = np.linalg.norm(obs["achieved_goal"] - obs["desired_goal"]) <= 0.02
        assert reward == near - 1 and info["is_success"] == near


# ---------------------------------------------------------------------------------- run


@pytest.mark.parametrize(
    ("acting_head", "collecting", "together"), [("all", (4, 4, 2), 1), ("one", (1, 16, 2), 2)]
)
def test_train_does_what_algorithm_2_says(acting_head, collecting, together, tmp_path, monkeypatch):
    """The calls, in order: B_h filled with as much as B_o holds; then Algorithm 1 beside the heads,
    which are updated in turn, each with a mini-batch of its own; the targets once a cycle; the
    normaliser fed with every step."""
    calls, agents, goals, scores, snapshots, threads = [], [], [], [], [], set()
    heads_moved = threading.Event()

    class Spy(EnsembleDDPG):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            agents.append(self)

        def update_heads(self, heads, batches, map):
            assert len(heads) == together
            for k, batch in zip(heads, batches, strict=True):
                calls.append((k, batch["obs"].tobytes()))
                assert len(batch["obs"]) == 16
            losses = super().update_heads(heads, batches, map)
            if 3 in heads:
                heads_moved.set()
            return losses

        def update_targets(self):
            calls.append("targets")
            super().update_targets()

        def act(self, obs, goal, heads=slice(None)):
            goals.append(goal)
            return super().act(obs, goal, heads)

        def snapshot_q_variance(self, map):
            calls.append("snapshot")
            snapshots.append(copy.deepcopy(self))
            return super().snapshot_q_variance(map)

    def spy_on_the_first(her_buffer, original_buffer, q_variance, size, *args):
        calls.append(("first", size))
        assert size == min(original_buffer.size * 50, her_buffer.capacity)
        return update_her_buffer(her_buffer, original_buffer, q_variance, size, *args)

    def spy_score(original_buffer, q_variance, size, *args):
        """Lines 3-5, not before the heads have moved on."""
        assert heads_moved.wait(timeout=60)
        heads_moved.clear()
        threads.add(threading.current_thread())
        batch, variance = score(original_buffer, q_variance, size, *args)
        rows = [batch[name] for name in ("obs", "action", "goal")]
        scores.append((variance, rows, agents[0].q_variance(*rows)))
        return batch, variance

    def spy_add(self, batch, variance):
        if len(variance) == 128:
            calls.append("stored")
        return add(self, batch, variance)

    add = HERBuffer.add
    monkeypatch.setattr(HERBuffer, "add", spy_add)
    monkeypatch.setattr(assemble, "EnsembleDDPG", Spy)
    monkeypatch.setattr(run, "update_her_buffer", spy_on_the_first)
    monkeypatch.setattr(run, "score", spy_score)
    settings = {
        **SMALL_TRAINING,
        "cycles": 2,
        "updates": 3,
        "batch_size": 16,
        "heads": 4,
        "num_workers": 1,
    }
    settings |= {"acting_head": acting_head, "scored_per_drawn": 2.0, "her_buffer_capacity": 1700}
    settings |= {"heads_at_once": together}
    (row,) = train(Config(**settings, env="PointMassEmptyEnv-v1", out=str(tmp_path / "run")))
    names = [call if isinstance(call, str) else call[0] for call in calls]
    sweep = ["snapshot", 0, 1, 2, 3, "stored"]  # B_h stands still meanwhile
    assert names == ["snapshot", "first"] + 2 * (3 * sweep + ["targets"])
    # the scores are the critics' at the beginning of the sweep, from another thread
    assert threading.current_thread() not in threads and len(threads) == 1
    assert len(scores) == len(snapshots) - 1 == 6
    for (variance, rows, moved), critics in zip(scores, snapshots[1:], strict=True):
        np.testing.assert_allclose(variance, critics.q_variance(*rows), rtol=1e-3, atol=1e-6)
        assert np.abs(variance - moved).max() > 1e-4
    # scored for each one drawn: 2, in each sweep
    drawn = 4 * 16
    assert [len(variance) for variance, *_ in scores] == 6 * [2 * drawn]
    batches = [call[1] for call in calls if not isinstance(call, str)][1:]
    assert len(set(batches)) == len(batches)
    # warm-up and 2 cycles, in 16 environments by 4 heads or one; then a round of evaluation, by all
    assert [g.shape for g in goals] == 150 * [collecting] + 50 * [(4, 4, 2)]
    assert agents[0].normalizer.count == row["env_steps"] == 3 * 16 * 50
    assert len({g.tobytes() for g in goals}) == 4


@pytest.mark.parametrize("where", ["score", "update"])
def test_an_error_beside_the_training_ends_the_run_with_its_message(where, tmp_path, monkeypatch):
    def fail(*args):
        raise FloatingPointError("NaN or Inf in here")

    monkeypatch.setattr(
        *{"score": (run, "score"), "update": (EnsembleDDPG, "update_heads")}[where], fail
    )
    settings = {**SMALL_TRAINING, "env": "PointMassEmptyEnv-v1", "num_workers": 1}
    with pytest.raises(FloatingPointError, match="in here"):
        train(Config(**settings, out=str(tmp_path / "run")))
    assert threading.active_count() == 1


def test_success_is_read_at_the_last_step():
    def to_the_goal(t, rows, obs, goal):
        return (goal - obs) / 0.05

    def there_and_away_again(t, rows, obs, goal):
        return to_the_goal(t, rows, obs, goal) if t < 40 else -np.sign(goal)

    with ParallelEnvs("PointMassEmptyEnv-v1", 16, 1) as envs:
        envs.reset(0)
        episodes, success = run.rollout(envs, to_the_goal, 50)
        assert success.all()
        assert episodes["obs"].shape == (16, 51, 2) and episodes["action"].shape == (16, 50, 2)
        np.testing.assert_array_equal(episodes["obs"], episodes["achieved_goal"])
        episodes, success = run.rollout(envs, there_and_away_again, 50)
        reached = np.linalg.norm(episodes["obs"][:, 40] - episodes["desired_goal"], axis=1)
        assert np.all(reached < 0.05) and not success.any()


def test_heads_act_in_their_own_environments():
    agent = random_agent(num_heads=4, obs_dim=2, goal_dim=2)
    rng = np.random.default_rng(0)
    obs, goal = rng.normal(size=(8, 2)), rng.normal(size=(8, 2))
    for parts in (1, 2, 4, 8):  # workers
        rows = [slice(i * 8 // parts, (i + 1) * 8 // parts) for i in range(parts)]

        def acted(heads):
            policy = run.acting_heads(agent, heads, 8)
            return np.concatenate([policy(0, r, obs[r], goal[r]) for r in rows])  # noqa: B023

        actions = acted(4)
        for row in range(8):
            k = row // 2
            one = agent.act(obs[None, [row]], goal[None, [row]], slice(k, k + 1))
            np.testing.assert_allclose(actions[row], one[0, 0], atol=1e-5)
        only_first = agent.act(obs[None], goal[None], slice(1))[0]
        np.testing.assert_allclose(acted(1), only_first, atol=1e-5)


def test_exploration_noise():
    steps, n = 4, 25_000

    def explored(noise, random_actions):
        rng = np.random.default_rng(0)
        still = SimpleNamespace(act=lambda obs, goal, heads: np.full((1, obs.shape[1], 2), 0.9))
        drawn = run.exploration(rng, (steps, n, 2), noise, random_actions)
        policy = run.acting_heads(still, 1, n, drawn)
        half = [slice(0, n // 2), slice(n // 2, n)]
        return np.concatenate(
            [
                policy(t, r, np.zeros((n // 2, 2)), np.zeros((n // 2, 2)))
                for t in range(steps)
                for r in half
            ]
        )

    actions = explored(noise=0.2, random_actions=0.0)
    np.testing.assert_allclose(np.quantile(actions - 0.9, 0.25), -0.2 * 0.6745, atol=0.005)
    assert abs((actions == 1).mean() - 0.3085) < 0.01  # P(0.9 + 0.2 z > 1), clipped
    below = actions[actions < 1]
    assert len(np.unique(below)) > 0.99 * len(below)  # no two steps or rows share their noise
    actions = explored(noise=0.0, random_actions=0.3)
    kept = (actions == 0.9).all(axis=1)
    assert abs(kept.mean() - 0.7) < 0.01
    assert np.all((actions != 0.9).any(axis=1) == ~kept)  # the whole action is replaced
    assert len(np.unique(actions[~kept, 0])) == (~kept).sum()  # by one of its own
    np.testing.assert_allclose(np.quantile(actions[~kept], [0.25, 0.75]), [-0.5, 0.5], atol=0.02)


def test_the_same_seed_gives_the_same_rows(tmp_path):
    settings = {**SMALL_TRAINING, "env": "FetchReach-v1", "epochs": 2}
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        train(Config(**settings, seed=seed, out=str(tmp_path / name)))
    a, b, c = (without_timing(tmp_path / name) for name in "abc")
    assert len(a) == 2 and a == b and a != c
    assert (tmp_path / "a" / "curve.png").read_bytes()[:4] == b"\x89PNG"
    head = (tmp_path / "a" / "progress.csv").read_text().splitlines()[0]
    assert head == ",".join(COLUMNS)
    # 16 environments, 50 steps: 1 warm-up and 2 cycles, then 2 cycles
    assert [row["env_steps"] for row in a] == [3 * 800, 5 * 800]
    # what a cycle draws, 2 updates of 16 heads; the first episodes, 2 x 16 of 50 steps, filled it
    assert [row["her_buffer_size"] for row in a] == [2 * 16 * 32, 2 * 16 * 32]


def test_each_seed_and_epoch_has_random_numbers_of_its_own(tmp_path, monkeypatch):
    """Seeds of the environments; what episodes, Algorithm 1 and draws take, each its own stream."""
    resets, streams = [], {"exploration": [], "score": [], "sample": []}

    def spy(owner, name, note):
        function = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *args: (note(*args), function(*args))[1])

    def stream(name, place):  # a PCG64's increment tells its stream from all others
        return lambda *args: streams[name].append(args[place].bit_generator.state["state"]["inc"])

    spy(ParallelEnvs, "reset", lambda envs, seed: resets.append(seed))
    spy(run, "exploration", stream("exploration", 0))
    spy(run, "score", stream("score", 3))
    spy(run, "update_her_buffer", stream("score", 4))
    spy(HERBuffer, "sample", stream("sample", 2))
    settings = {**SMALL_TRAINING, "env": "PointMassEmptyEnv-v1", "epochs": 2, "num_workers": 1}
    for seed in (0, 1):
        train(Config(**settings, seed=seed, out=str(tmp_path / str(seed))))
    assert len(resets) == len(set(resets)) == 2 * 2 * 2  # seeds, epochs, training and testing
    assert {name: len(set(used)) for name, used in streams.items()} == dict.fromkeys(streams, 4)
    assert len(set().union(*streams.values())) == 3 * 4
    assert len(streams["exploration"]) == 2 * (3 + 2)  # the first epoch has one cycle more


@pytest.mark.parametrize(
    "options",
    [
        {"priority": "uniform"},
        {"priority": "variance"},
        {"priority": "within-kind"},
        {"importance": "none"},
        {"importance": "inverse"},
        {"acting_head": "one"},
        {"heads": 1},
        {"heads": 3, "temperature": 15.0},
        {"heads": 1, "updates": 1, "scored_per_drawn": 4.0},
        {"scored_per_drawn": 0.0625, "her_buffer_capacity": 64},
        {"buffer_size": 800, "cycles": 4},
    ],
    ids=str,
)
def test_every_option_runs_to_the_end(options, tmp_path):
    settings = {**SMALL_TRAINING, "env": "PointMassEmptyEnv-v1", "num_workers": 1, **options}
    (row,) = train(Config(**settings, out=str(tmp_path / "run")))
    assert list(row.keys() - set(COLUMNS)) == [] and len(row) == len(COLUMNS)
    assert all(math.isfinite(value) for value in row.values()), row
    assert threading.active_count() == 1


@pytest.mark.slow
def test_point_mass_is_learned_and_not_without_relabelling(tmp_path):
    settings = {"env": "PointMassEmptyEnv-v1", "epochs": 1, "updates": 5, "batch_size": 64}
    settings |= {"cycles": 20, "action_penalty": 0.1}  # with 1 it takes ten times as long
    (learned,) = train(Config(**settings, out=str(tmp_path / "her")))
    assert learned["test_success_rate"] >= 0.9
    (control,) = train(Config(**settings, relabel_ratio=0.0, out=str(tmp_path / "no")))
    assert control["test_success_rate"] < 0.1
