"""The core as a specification, in the order of the files: vcp, her, ensemble, envs_point, run.

The line below a test's name says what would be wrong if the test failed. Where there is a formula,
the expected value comes from a slow and obvious version of the formula in here. The tests marked
slow train something: leave them out with  pytest -m "not slow".
"""

import copy
import math
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal, localcontext
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import run
from ensemble import HIDDEN, EnsembleDDPG, Normalizer
from envs_point import PointMass
from harness.tasks import make_env
from harness.testing import (
    COLUMNS,
    SMALL_TRAINING,
    assert_drawn_as_in_her,
    assert_frequencies,
    exact_reward,
    numbered_episodes,
    random_agent,
    spied_run,
    without_timing,
)
from harness.workers import ParallelEnvs
from her import EpisodeBuffer, relabel_future
from run import Config, train
from vcp import HERBuffer, update_her_buffer, value_consistency_priority

# ---------------------------------------------------------------------------------- vcp


@settings(deadline=None)
@given(
    variance=arrays(np.float64, st.integers(1, 50), elements=st.floats(0, 1e4)),
    temperature=st.sampled_from([1, 5, 9, 11, 15]) | st.floats(0.5, 30),
)
def test_priority_is_eq_4_to_the_letter(variance, temperature):
    """Transitions would be drawn by another formula than Eq. (4)."""
    with localcontext() as exact:
        exact.prec = 50
        sigma2, eps = [Decimal(float(v)) for v in variance], Decimal("1e-6")
        denominator = sum(max(sigma2) - s + eps for s in sigma2)
        p = [((max(sigma2) - s + eps) / denominator) ** Decimal(temperature) for s in sigma2]
        expected = [float(x / sum(p)) for x in p]
    np.testing.assert_allclose(
        value_consistency_priority(variance, temperature), expected, rtol=1e-9
    )


def test_priority_at_the_extremes():
    """Powers of small shares would vanish, so that some are never drawn; or a NaN would be."""
    # Eq. (4) as it is printed raises about 1/N to the power 𝒯: 163840^-15 is 1e-78, and the largest
    # variance's share (1e-6 / 1e2 / N)^15 is 1e-198.
    variance = np.float32(np.random.default_rng(0).exponential(size=163_840) ** 2)
    for temperature in (15, 30):
        p = value_consistency_priority(variance, temperature)
        assert p.dtype == np.float64 and np.all(p > 0) and abs(p.sum() - 1) < 1e-12
        assert np.all(np.diff(p[np.argsort(variance)]) <= 0)
    # σ²_max - σ² + ε with ε = 1: 4, 3, 1; squared: 16, 9, 1
    p = value_consistency_priority(np.array([0.0, 1.0, 3.0]), temperature=2, eps=1.0)
    np.testing.assert_allclose(p, np.array([16, 9, 1]) / 26)
    for bad in ([1.0, math.nan], [math.inf, 0.0]):
        with pytest.raises(FloatingPointError):
            value_consistency_priority(np.array(bad), 9)


def transitions(values):
    """A mini-batch whose rows are told apart by `values`; every third is an original."""
    values = np.asarray(values, dtype=np.float32)
    return {"obs": np.stack([values, values], axis=1), "hindsight": values % 3 != 0}


def filled(variance, hindsight=None, **how):
    """B_h with the rows 0, 1, 2, ... of these variances."""
    buffer, batch = HERBuffer(len(variance), **how), transitions(range(len(variance)))
    if hindsight is not None:
        batch["hindsight"] = np.array(hindsight)
    buffer.add(batch, np.array(variance))
    buffer.update_priorities()
    return buffer


@settings(deadline=None)
@given(capacity=st.integers(1, 12), sizes=st.lists(st.integers(1, 12), min_size=1, max_size=8))
def test_her_buffer_is_first_in_first_out(capacity, sizes):
    """B_h would not hold the newest, would mix up what belongs to a transition, or would go on
    otherwise from a checkpoint."""
    buffer, again = HERBuffer(capacity, temperature=2), HERBuffer(capacity, temperature=2)
    stored = 0

    def add(buffer, new):
        values = np.arange(stored, stored + new)
        buffer.add(transitions(values), values * 0.1)

    for size in sizes:
        add(buffer, min(size, capacity))
        stored += min(size, capacity)
    again.load_state_dict(copy.deepcopy(buffer.state_dict()))
    for ring in (buffer, again):
        add(ring, 1)
        ring.update_priorities()
        kept = [*range(stored + 1)][-capacity:]
        rows = {name: x[: ring.size] for name, x in ring.data.items()}
        assert sorted(rows["obs"][:, 0]) == kept
        np.testing.assert_allclose(rows["variance"], rows["obs"][:, 0] * 0.1)
        np.testing.assert_array_equal(rows["hindsight"], rows["obs"][:, 0] % 3 != 0)
        p = value_consistency_priority(rows["variance"], 2)
        np.testing.assert_allclose(ring.probabilities, p)
        assert set(ring.sample(20, np.random.default_rng(0))["obs"][:, 0]) <= set(kept)


def test_her_buffer_refuses_what_it_cannot_use():
    """A variance would be broadcast, or draws would go by priorities that no longer hold."""
    buffer, rng = HERBuffer(5, temperature=1), np.random.default_rng(0)
    for variance in (np.zeros((3, 1)), np.zeros(2), np.float64(1)):
        with pytest.raises(ValueError, match="one number for each transition"):
            buffer.add(transitions(range(3)), variance)
    with pytest.raises(ValueError, match="6 transitions do not fit"):
        buffer.add(transitions(range(6)), np.zeros(6))
    for values in ([0, 1, 2], [3, 4]):  # at first, and after new ones came
        batch = {name: torch.from_numpy(x) for name, x in transitions(values).items()}
        buffer.add(batch, torch.arange(float(len(values))))
        with pytest.raises(ValueError, match="call update_priorities"):
            buffer.sample(4, rng)
        buffer.update_priorities()
        assert buffer.sample(4, rng)["obs"].shape == (4, 2)
    np.testing.assert_array_equal(buffer.data["variance"], [0, 1, 2, 0, 1])


@pytest.mark.parametrize("priority", ["consistency", "variance", "uniform", "within-kind"])
def test_sampling_follows_the_priorities(priority):
    """The method, or an ablation of Section 5.6, would draw by something else than it says."""
    variance = np.array([0.0, 0.1, 0.2, 0.5, 0.9, 1.0])
    buffer = filled(variance, temperature=3, priority=priority)
    x = {
        "consistency": 1 - variance,
        "variance": variance,
        "uniform": np.ones(6),
        "within-kind": np.array([0.5, 0.9, 0.8, 0, 0.1, 0]),  # of originals 0 and 3, and the others
    }[priority] + 1e-6
    expected = np.empty(6)
    for kind in [[0, 3], [1, 2, 4, 5]] if priority == "within-kind" else [range(6)]:
        expected[kind] = len(kind) / 6 * x[kind] ** 3 / np.sum(x[kind] ** 3)
    np.testing.assert_allclose(buffer.probabilities, expected, rtol=1e-12)
    drawn = buffer.sample(200_000, np.random.default_rng(0))["obs"][:, 0].astype(int)
    expected[expected < 1e-9] = 0
    assert_frequencies(np.bincount(drawn, minlength=6), expected)


def test_sampling_is_right_for_every_random_number():
    """A random number at an edge would draw a neighbour, or one with next to no probability."""
    buffer = filled([2.0, 4.0, 2.0], temperature=1)

    class Edge:  # the smallest and the largest that a Generator's random() gives, and p_1
        def random(self, size):
            return np.array([0.0, np.nextafter(1, 0), buffer.probabilities[0]])[:size]

    assert buffer.sample(3, Edge())["obs"][:, 0].tolist() == [0, 2, 1]


MIXED = [True, False] * 3  # hindsight and originals


@pytest.mark.parametrize(
    ("importance", "priority", "hindsight"),
    [(importance, "consistency", MIXED) for importance in ("paper", "inverse", "none")]
    + [("paper", "within-kind", hindsight) for hindsight in (MIXED, [True] * 6, [False] * 6)],
    ids=str,
)
@pytest.mark.filterwarnings("error")  # as of the mean of a kind that was not drawn
def test_importance_weights(importance, priority, hindsight):
    """A loss would not be weighted by w_i = p_i / Σ p or would grow with the scale of w; within
    kinds, p would count against a kind a second time."""
    how = {"temperature": 2, "importance": importance, "priority": priority}
    buffer = filled([0.0, 5.0, 0.1, 9.0, 0.2, 7.0], hindsight, **how)
    batch = buffer.sample(400, np.random.default_rng(0))
    p = buffer.probabilities[batch["obs"][:, 0].astype(int)]
    w = {"paper": p, "inverse": 1 / p, "none": np.ones(400)}[importance]
    kinds = [np.ones(400, bool)]  # all are one
    if priority == "within-kind":
        kinds = [kind for kind in (batch["hindsight"], ~batch["hindsight"]) if kind.any()]
        share = buffer.probabilities[np.array(hindsight)].sum()
        assert share == pytest.approx(np.mean(hindsight))
    for kind in kinds:
        expected = w[kind] / w[kind].mean()
        np.testing.assert_allclose(batch["weight"][kind], expected, rtol=1e-6)


def test_algorithm_1_scores_and_stores_what_it_drew():
    """A transition would be stored with the variance or the priority of another one."""
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
    """B_o would lose an episode that still fits, keep the oldest ones or the first ones for ever,
    tear episodes apart, or say that they went to other rows."""
    rng, episodes = np.random.default_rng(0), numbered_episodes(150, horizon=3)
    buffer = EpisodeBuffer(5 * 3 + 2, 3, 2, 2, 2, 0.8, exact_reward)  # five episodes of three steps
    added, overwritten = 0, set()
    for new in (2, 1, 4, *50 * [2], 5):
        some = {name: x[added : added + new] for name, x in episodes.items()}
        slots = buffer.add(some, rng)
        ids = buffer.episodes["achieved_goal"][:, 0, 0].astype(int)
        np.testing.assert_array_equal(ids[slots], range(added, added + new))
        added += new
        assert buffer.size == len(set(ids)) == min(added, 5)
        for name, x in buffer.episodes.items():
            np.testing.assert_array_equal(x, episodes[name][ids])
        overwritten |= set(slots) if new == 2 else set()
    assert overwritten == set(range(5))


def test_episodes_that_do_not_fit_are_refused_by_name():
    """NumPy would broadcast another shape, or B_o would hold no whole episode."""
    buffer, rng = EpisodeBuffer(200, 50, 2, 2, 2, 0.8, exact_reward), np.random.default_rng(0)
    episodes = numbered_episodes(4)
    for name, wrong in (
        ("obs", episodes["obs"][:, 1:]),
        ("achieved_goal", episodes["achieved_goal"][0]),
        ("desired_goal", episodes["desired_goal"][:2]),
        ("action", episodes["action"][..., None]),
    ):
        with pytest.raises(ValueError, match=re.escape(f'episodes["{name}"] is {wrong.shape}')):
            buffer.add({**episodes, name: wrong}, rng)
    with pytest.raises(ValueError, match="5 episodes do not fit"):
        buffer.add(numbered_episodes(5), rng)
    assert buffer.size == 0
    with pytest.raises(ValueError, match="holds no episode"):
        EpisodeBuffer(49, 50, 2, 2, 2, 0.8, exact_reward)


@pytest.mark.parametrize(
    ("n", "horizon", "ratio"), [(4, 50, 0.8), (3, 5, 0.5), (2, 3, 0.0), (2, 3, 1.0), (1, 1, 0.8)]
)
def test_future_relabelling_draws_later_steps_of_the_same_episode(n, horizon, ratio):
    """A goal would be of the past or of another episode, or drawn too often; or the reward would be
    that of the state before the action."""
    rng = np.random.default_rng(0)
    batch = relabel_future(numbered_episodes(n, horizon), 200_000, rng, ratio, exact_reward)
    assert_drawn_as_in_her(batch, n, horizon, ratio)


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
    """Targets would be clipped to a range that the returns leave, or a reward be broadcast."""
    with pytest.raises(error, match=message):
        relabel_future(numbered_episodes(), 500, np.random.default_rng(0), 0.8, reward_fn)


@pytest.mark.parametrize("name", ["FetchReach-v1", "HandManipulateBlockRotateZ-v0", "Reacher-v2"])
def test_recomputed_rewards_are_the_environments_own(name):
    """Relabelled transitions would have other rewards than those that were played."""
    env, rng = make_env(name), np.random.default_rng(0)
    rewards, achieved, goals = [], [], []
    for seed in range(6):
        env.reset(seed=seed)
        for _ in range(20):
            obs, reward, *_ = env.step(rng.uniform(-1, 1, env.action_space.shape))
            rewards.append(reward)
            achieved.append(obs["achieved_goal"])
            goals.append(obs["desired_goal"])
    achieved, goals = np.float32(achieved), np.float32(goals)  # as B_o stores them
    np.testing.assert_array_equal(env.unwrapped.compute_reward(achieved, goals, {}), rewards)


# ---------------------------------------------------------------------------------- ensemble


def plain(params, *x):
    """One head's network as anyone would write it, but for the actor's tanh."""
    w1, b1, w2, b2, w3, b3, w4, b4 = params
    h = torch.relu(torch.cat(x, dim=-1) @ w1.T + b1)
    h = torch.relu(h @ w2.T + b2)
    h = torch.relu(h @ w3.T + b3)
    return h @ w4.T + b4


def copies(net):
    """The eight tensors of each head, copied; the first four, the trunk's, are the same for all."""
    trunk, *heads = (
        [p.detach().clone().requires_grad_() for p in four] for four in (net.trunk, *net.own)
    )
    return [[*trunk, *head] for head in heads]


def random_batch(n=32, seed=0):
    rng = np.random.default_rng(seed)
    return {
        "obs": rng.normal(size=(n, 5)),
        "action": rng.uniform(-1, 1, (n, 2)),
        "next_obs": rng.normal(size=(n, 5)),
        "goal": rng.normal(size=(n, 3)),
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


@torch.no_grad()
def test_the_ensemble_is_16_separate_networks():
    """A head would act or judge with another head's layers, or σ² would not be over the heads."""
    agent, batch = random_agent(), random_batch()
    state, _, action, *_ = as_tensors(agent, batch)
    actors, critics = copies(agent.actor), copies(agent.critic)
    # all heads on the same rows
    q = torch.stack([plain(critic, state, action)[:, 0] for critic in critics])
    variance = agent.q_variance(batch["obs"], batch["action"], batch["goal"])
    np.testing.assert_allclose(variance, q.numpy().astype(float).var(axis=0), rtol=1e-3)
    # each head on two other rows
    rows = state.reshape(16, 2, 8)
    expected = [torch.tanh(plain(*pair)) for pair in zip(actors, rows, strict=True)]
    obs, goal = batch["obs"].reshape(16, 2, 5), batch["goal"].reshape(16, 2, 3)
    np.testing.assert_allclose(agent.act(obs, goal), torch.stack(expected), atol=1e-5)
    value = [plain(*both)[:, 0] for both in zip(critics, rows, expected, strict=True)]
    np.testing.assert_allclose(agent.value(obs, goal), torch.stack(value), atol=1e-4)
    # only some heads
    alone = agent.act(batch["obs"][None], batch["goal"][None], slice(1))
    np.testing.assert_allclose(alone[0], torch.tanh(plain(actors[0], state)), atol=1e-5)
    for wrong in (batch["obs"][:16], obs[:2], obs[0], obs[None]):
        with pytest.raises(ValueError, match=re.escape(f"obs is {wrong.shape}")):
            agent.act(wrong, goal)


def test_networks_have_the_papers_size_and_start_like_their_targets():
    """The networks would not be those of Figure 1(a) and Appendix B, or all heads start alike."""
    agent, again = (EnsembleDDPG(10, 3, 4, gamma=0.98) for _ in range(2))
    other = EnsembleDDPG(10, 3, 4, gamma=0.98, seed=1)
    assert HIDDEN == 256 and agent.num_heads == 16
    assert [tuple(p.shape) for p in [*agent.critic.trunk, *agent.critic.own[3]]] == [
        (256, 17), (256,), (256, 256), (256,), (256, 256), (256,), (1, 256), (1,),
    ]  # fmt: skip
    for net, target in ((agent.actor, agent.target_actor), (agent.critic, agent.target_critic)):
        for p, q in zip(net.trunk + net.stacks, target.trunk + target.stacks, strict=True):
            assert torch.equal(p, q) and p.data_ptr() != q.data_ptr()
        w = net.stacks[0]
        assert abs(w.std().item() - math.sqrt(2 / 512)) < 1e-3  # Xavier-uniform
        assert not torch.equal(w[0], w[1])
    assert torch.equal(agent.actor.stacks[0], again.actor.stacks[0])
    assert not torch.equal(agent.actor.stacks[0], other.actor.stacks[0])


@pytest.mark.parametrize("turns", [[[1], [2], [1], [0], [1]], [[0, 1, 2], [2, 0]]], ids=str)
def test_updates_are_those_of_plain_ddpg(turns):
    """A step would not follow Eqs. (2) and (3): with the head's own targets, clipped, and weights;
    both gradients before either step; the trunk's added up over the heads that step together."""
    agent = random_agent(num_heads=3, action_penalty=0.3, learning_rate=2e-3)
    actors, critics = copies(agent.actor), copies(agent.critic)
    target_actors, target_critics = copies(agent.target_actor), copies(agent.target_critic)
    adam_of_trunks = torch.optim.Adam(actors[0][:4] + critics[0][:4], 2e-3)
    adams = [torch.optim.Adam(actors[k][4:] + critics[k][4:], 2e-3) for k in range(3)]
    params = [
        [p for net in (agent.actor, agent.critic) for p in (*net.trunk, *net.own[k])]
        for k in range(3)
    ]
    last = {}  # the gradients with which the agent last stepped: Adam's step hides their scale
    agent.optimizer.register_step_pre_hook(
        lambda *_: last.update({p: p.grad for own in params for p in own})
    )
    batches = (random_batch(seed=i) for i in range(6))
    for together in turns:
        drawn, expected = [next(batches) for _ in together], []
        for k, batch in zip(together, drawn, strict=True):
            state, next_state, action, reward, weight = as_tensors(agent, batch)
            with torch.no_grad():
                next_action = torch.tanh(plain(target_actors[k], next_state))
                y = reward + 0.9 * plain(target_critics[k], next_state, next_action)
                y = torch.clip(y, -1 / (1 - 0.9), 0)
            critic_loss = (weight * (plain(critics[k], state, action) - y) ** 2).mean()
            pi = torch.tanh(plain(actors[k], state))
            actor_loss = -(weight * plain(critics[k], state, pi)).mean()
            actor_loss = actor_loss + 0.3 * (weight * pi**2).mean()
            for loss, own in ((critic_loss, critics[k]), (actor_loss, actors[k])):
                gradients = torch.autograd.grad(loss, own, retain_graph=True)
                for p, gradient in zip(own, gradients, strict=True):
                    p.grad = gradient if p.grad is None else p.grad + gradient
            expected.append(torch.stack([critic_loss, actor_loss]).detach())
        if len(together) == 1:
            losses = agent.update_head(*together, *drawn)[None]
        else:
            losses = agent.update_heads(together, drawn)
        torch.testing.assert_close(losses, torch.stack(expected), rtol=1e-4, atol=1e-5)
        for k in together:
            gradients = [p.grad for p in actors[k] + critics[k]]
            torch.testing.assert_close(
                [last[p] for p in params[k]], gradients, rtol=1e-3, atol=1e-5
            )
        for adam in (adam_of_trunks, *(adams[k] for k in together)):
            adam.step()
            adam.zero_grad()
    for k in range(3):
        torch.testing.assert_close(params[k], actors[k] + critics[k], rtol=1e-3, atol=3e-5)


def backwards(function, *lists):
    """A `map` whose last call is the first to be done."""
    return reversed([function(*arguments) for arguments in reversed([*zip(*lists, strict=True)])])


def test_any_number_of_threads_gives_the_same_bits():
    """The same seed would give other weights or variances where there are more cores."""
    rows = [random_batch(n=700)[name] for name in ("obs", "action", "goal")]
    learned = []
    with ThreadPoolExecutor(3) as three, ThreadPoolExecutor(16) as sixteen:
        for how in (map, backwards, three.map, sixteen.map):
            agent = random_agent(num_heads=8)
            for i in range(2):
                batches = [random_batch(seed=10 * i + k) for k in range(8)]
                losses = agent.update_heads(range(8), batches, how)
            weights = [p.detach() for p in agent.actor.parameters() + agent.critic.parameters()]
            variance = torch.from_numpy(agent.snapshot_q_variance(how)(*rows))
            learned.append([losses, variance, *weights])
    for others in learned[1:]:
        assert all(map(torch.equal, learned[0], others))
    np.testing.assert_allclose(learned[0][1], agent.q_variance(*rows), rtol=1e-3)
    with pytest.raises(ValueError, match="2 heads and 1 mini-batches"):
        agent.update_heads([0, 1], batches[:1])


def test_update_of_a_head_moves_it_and_the_trunk_and_nothing_else():
    """A head would learn from the mini-batches of another one, or a target would move early."""
    agent = random_agent(num_heads=4)
    before = copy.deepcopy(agent.state_dict()["networks"])
    agent.update_head(2, random_batch())
    after = agent.state_dict()["networks"]
    for trained, old, new in zip([True, True, False, False], before, after, strict=True):
        moved = [not torch.equal(p, q) for p, q in zip(old[:4], new[:4], strict=True)]
        assert moved == 4 * [trained]  # the trunk's
        for p, q in zip(old[4:], new[4:], strict=True):
            moved = [not torch.equal(*head) for head in zip(p, q, strict=True)]
            assert moved == [False, False, trained, False]


@pytest.mark.parametrize(("far", "bound"), [(1000.0, 0.0), (-1000.0, -10.0)])
def test_targets_are_clipped_to_the_range_of_returns(far, bound):
    """A target far outside [-1/(1-γ), 0] = [-10, 0] would be learned."""
    agent, batch = random_agent(num_heads=2), random_batch()
    agent.target_critic.stacks[3].fill_(far)
    state, _, action, _, weight = as_tensors(agent, batch)
    q = plain(copies(agent.critic)[1], state, action).detach()
    loss, _ = agent.update_head(1, batch)
    torch.testing.assert_close(loss, (weight * (q - bound) ** 2).mean(), rtol=1e-4, atol=1e-5)


def test_polyak_moves_the_shared_trunk_once_for_each_head():
    """Targets would follow at another speed than those of the released code."""
    agent = random_agent(num_heads=5, polyak=0.9)
    pairs = [(agent.target_actor, agent.actor), (agent.target_critic, agent.critic)]
    expected = copy.deepcopy([target.trunk + target.stacks for target, _ in pairs])
    for tensors, (_, net) in zip(expected, pairs, strict=True):
        for k in range(5):  # as it is said: for each head, the trunk and the head
            for p, q in zip(tensors[:4], net.trunk, strict=True):
                p.mul_(0.9).add_(0.1 * q.detach())
            for p, q in zip(tensors[4:], net.stacks, strict=True):
                p[k] = 0.9 * p[k] + 0.1 * q[k].detach()
    agent.update_targets()
    for tensors, (target, _) in zip(expected, pairs, strict=True):
        torch.testing.assert_close(target.trunk + target.stacks, tensors)


def test_normalizer_against_numpy():
    """Inputs would be standardised by something else than the mean and deviation of all rows."""
    x = np.random.default_rng(0).normal([0, 5, -1000, 3], [1, 0.1, 500, 0], (10_000, 4))
    normalizer = Normalizer(4)
    normalizer.update(x[:0])  # no rows change nothing
    assert normalizer.mean.tolist() == 4 * [0] and normalizer.std.tolist() == 4 * [1]
    for part in np.array_split(x, 7):
        normalizer.update(part)
    clipped = np.clip(x, -200, 200)
    mean, std = clipped.mean(axis=0), np.maximum(clipped.std(axis=0), 0.01)
    np.testing.assert_allclose(normalizer.mean, mean, rtol=1e-5)
    np.testing.assert_allclose(normalizer.std, std, rtol=1e-4)
    row = torch.tensor([[100.0, 5.05, -1e9, 3.02]])  # the first is beyond 5 standard deviations
    expected = np.clip((np.clip(row.numpy(), -200, 200) - mean) / std, -5, 5)
    np.testing.assert_allclose(normalizer(row), expected, rtol=1e-3)


# ---------------------------------------------------------------------------------- envs_point


@pytest.mark.parametrize(
    "name", ["PointMassEmptyEnv-v1", "PointMassWallEnv-v1", "SparseReacher-v1"]
)
def test_our_environments_pass_gymnasiums_checker(name, recwarn):
    """Other programs could not use the environment, or a seed would not give the same again."""
    env = gym.make(name, disable_env_checker=True).unwrapped
    check_env(env, skip_render_check="Reacher" in name)  # MuJoCo's windows need a display
    # Reacher's spaces are unbounded, as MuJoCo's own are; the checker remarks on that
    own = [w for w in recwarn if "infinity" not in str(w.message)]
    assert not own, [str(w.message) for w in own]


@pytest.mark.parametrize("name", ["PointMassEmptyEnv-v1", "PointMassWallEnv-v1"])
def test_a_picture_shows_the_circle_where_it_is(name):
    """What `--play` shows would not be what was played."""
    env = gym.make(name, render_mode="rgb_array")
    obs, _ = env.reset(seed=3)
    picture = env.render()
    assert picture.shape == (360, 360, 3) and picture.dtype == np.uint8
    grey = (picture[180] == 90).all(axis=-1)  # along y = 0: the room's walls, and the wall's 0.83 m
    assert grey.mean() == pytest.approx((0.12 + 0.83 * ("Wall" in name)) / 1.32, abs=0.01)
    rows, columns = np.nonzero((picture == (0, 114, 178)).all(axis=-1))
    # rows go down, y goes up
    place = np.array([columns.mean() - 179.5, 179.5 - rows.mean()]) / 360 * 1.32
    np.testing.assert_allclose(place, obs["achieved_goal"], atol=0.02)


@pytest.mark.parametrize(
    ("name", "within"),
    [("PointMassEmptyEnv-v1", 0.05), ("PointMassWallEnv-v1", 0.05), ("SparseReacher-v1", 0.02)],
)
def test_success_is_within_the_threshold(name, within):
    """A goal would count as reached within another distance than the released code's."""
    env = gym.make(name, disable_env_checker=True).unwrapped
    achieved = np.array([[within - 1e-6, 0], [0, within + 1e-6]])
    assert env.compute_reward(achieved, np.zeros((2, 2)), {}).tolist() == [0, -1]
    if isinstance(env, PointMass):
        env.reset(seed=0)
        for x, y in achieved:
            env._xy, env._goal = (0.3, 0.3), (0.3 + x, 0.3 + y)
            _, reward, terminated, truncated, info = env.step([0, 0])
            assert (reward, info["is_success"]) == ((0, True) if x else (-1, False))
            assert not terminated and not truncated


def distance_to_wall(xy):
    """From points (N, 2) to the wall's axis, the segment from (-inf, 0) to (0.2, 0)."""
    return np.hypot(np.maximum(xy[:, 0] - 0.2, 0), xy[:, 1])


def in_small_steps(start, move):
    """Where a circle of radius 0.05 gets from `start` (N, 2) by `move`: after the contact with the
    wall, of radius 0.03, along the tangent there."""
    place, normal = start.copy(), np.zeros_like(start)
    for _ in range(1000):
        into = np.minimum((move * normal).sum(axis=1, keepdims=True), 0)
        place += (move - into * normal) / 1000
        away = place - np.stack([np.minimum(place[:, 0], 0.2), np.zeros(len(place))], axis=1)
        touches = (distance_to_wall(place) < 0.08) & ~normal.any(axis=1)
        normal[touches] = away[touches] / np.linalg.norm(away[touches], axis=1, keepdims=True)
    return place


@pytest.mark.parametrize("wall", [False, True])
def test_point_mass_is_stopped_by_walls_and_slides_along_them(wall):
    """The circle would go through a wall, stick to it, or move by more than the action; or a
    start or a goal would lie where the circle cannot be."""
    env, rng = PointMass(wall=wall), np.random.default_rng(0)
    starts, moves, ends, goals = [], [], [], []
    env.reset(seed=0)
    for i in range(4000):
        if i % 20 == 0:
            goals += [env.reset()[0][name] for name in ("achieved_goal", "desired_goal")]
        if i % 20 == 10:  # near the wall
            places = rng.uniform([-0.5, -0.13], [0.33, 0.13], (20, 2))
            env._xy = tuple(places[distance_to_wall(places) > 0.08 * wall][0])
        if i % 5 == 0:  # pushes on, beyond the bounds of an action too
            action = rng.uniform(-1.5, 1.5, 2)
        starts.append(env._xy)
        moves.append(np.clip(starts[-1] + 0.05 * np.clip(action, -1, 1), -0.55, 0.55) - starts[-1])
        ends.append(env.step(action)[0]["achieved_goal"])
    starts, moves, ends, goals = map(np.array, (starts, moves, ends, goals))
    assert np.isclose(np.abs(ends), 0.55).sum() > 100 and np.abs(ends).max() <= 0.55
    assert np.abs(goals).max() <= 0.55 and np.all(np.ptp(goals, axis=0) > 1)
    expected = starts + moves
    if wall:
        expected = in_small_steps(starts, moves)
        assert distance_to_wall(np.vstack([ends, goals])).min() >= 0.08 - 1e-12
        assert (distance_to_wall(ends) < 0.08 + 1e-12).sum() > 100
    np.testing.assert_allclose(ends, expected, atol=2e-4)


@pytest.mark.parametrize("push", [(-1, -1), (-1, -0.5), (-1, 1), (-0.5, -1)])
def test_point_mass_does_not_creep_into_the_wall(push):
    """Pushed straight into the round end for long, the circle would get in by rounding errors that
    grow, and come out on the other side."""
    env = PointMass(wall=True)
    env.reset(seed=0)
    env._xy = tuple((0.2, 0) - 0.1414 * np.array(push) / np.hypot(*push))
    for _ in range(200):
        xy = env.step(push)[0]["achieved_goal"]
        assert distance_to_wall(xy[None])[0] >= 0.08 - 1e-12
    env._xy = (0.27, 0.22)  # from here, by rounding, it touches where the flat face begins
    for _ in range(9):
        xy = env.step((-0.5, -1))[0]["achieved_goal"]
        assert distance_to_wall(xy[None])[0] >= 0.08 - 1e-12


def test_reacher_reports_the_fingertips_velocity():
    """The state would not be the eight numbers of Appendix A."""
    env = gym.make("SparseReacher-v1", disable_env_checker=True).unwrapped
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(30):
        obs, reward, *_, info = env.step(rng.uniform(-1, 1, 2))
        # the geometry of reacher.xml: links of 0.1 and 0.11; the second angle is from the first
        q, w = np.cumsum(env.data.qpos[:2]), np.cumsum(env.data.qvel[:2])
        links = np.array([0.1, 0.11])
        tip = [links @ np.cos(q), links @ np.sin(q)]
        velocity = [-links @ (np.sin(q) * w), links @ (np.cos(q) * w)]
        angles = env.data.qpos[:2]
        expected = np.concatenate([np.cos(angles), np.sin(angles), tip, velocity])
        np.testing.assert_allclose(obs["observation"], expected, atol=1e-6)
        np.testing.assert_array_equal(obs["observation"][4:6], obs["achieved_goal"])
        near = np.linalg.norm(obs["achieved_goal"] - obs["desired_goal"]) <= 0.02
        assert reward == near - 1 and info["is_success"] == near


# ---------------------------------------------------------------------------------- run


@pytest.mark.parametrize(
    ("changes", "together", "collecting"),
    [({}, 2, (1, 16, 2)), ({"acting_head": "all", "heads_at_once": 1}, 1, (4, 4, 2))],
)
def test_train_does_what_algorithm_2_says(changes, together, collecting):
    """The loop would not be Algorithm 2's, or line 13 would score with critics that move."""
    seen = spied_run(**changes)
    calls, (agent,) = seen.calls, seen.calls["agent"]
    # 3-11, and the normaliser; the first time at random, without training
    collect = ["explore", "rollout", "to B_o", "relabel", "normalise"]
    first = ["snapshot", "to B_h", "priorities", "fill B_h"]
    heads = [*together * ["draw"], "update"] * (4 // together)  # 14-16
    sweep = ["snapshot", *heads, "to B_h", "priorities"]  # B_h stands still meanwhile
    cycles = [*collect, *first, *2 * sweep, "targets", *2 * [*collect, *2 * sweep, "targets"]]
    order = [name for name in seen.order if name not in ("agent", "B_o", "B_h", "act")]
    assert order == [*collect, *cycles, *3 * ["rollout", "value"]]
    # 4-11: 16 environments by four heads or one; the tests by all; each episode has new goals
    assert [call.args[1].shape for call in calls["act"]] == 80 * [collecting] + 60 * [(4, 4, 2)]
    assert len({call.args[2].tobytes() for call in calls["act"]}) == 7
    episodes = [call.result[0] for call in calls["rollout"]]
    pairs = zip(calls["to B_o"], episodes[:4], strict=True)
    assert all(call.args[1] is e for call, e in pairs)
    assert agent.result.normalizer.count == seen.row["env_steps"] == 4 * 16 * 20
    # 13: from another thread, with the critics as they were at the beginning of the sweep
    assert calls["fill B_h"][0].args[3] == 2 * 16 * 20  # as much as B_o holds
    critics = [call.agent_then for call in calls["snapshot"]][1:]
    assert {call.thread for call in calls["score"]}.isdisjoint([threading.main_thread()])
    for call, then, later in zip(
        calls["score"], critics, [*critics[1:], agent.result], strict=True
    ):
        batch, variance = call.result
        rows = [batch[name] for name in ("obs", "action", "goal")]
        np.testing.assert_allclose(variance, then.q_variance(*rows), rtol=1e-3, atol=1e-6)
        assert np.abs(variance - later.q_variance(*rows)).max() > 1e-4
    # 14-16: each head in turn, with another mini-batch of B_h
    assert [k for call in calls["update"] for k in call.args[1]] == 6 * [0, 1, 2, 3]
    batches = [batch for call in calls["update"] for batch in call.args[2]]
    assert all(b is call.result for b, call in zip(batches, calls["draw"], strict=True))
    assert len({batch["obs"].tobytes() for batch in batches}) == 24
    # 17: what was scored is stored
    pairs = zip(calls["to B_h"][1:], calls["score"], strict=True)
    assert all(to.args[1] is scored.result[0] for to, scored in pairs)


@pytest.mark.parametrize(("owner", "name"), [(run, "score"), (EnsembleDDPG, "update_heads")])
def test_an_error_beside_the_training_ends_the_run_with_its_message(
    owner, name, tmp_path, monkeypatch
):
    """A run would hang, or go on without Algorithm 1."""

    def fail(*args):
        raise FloatingPointError("NaN or Inf in here")

    monkeypatch.setattr(owner, name, fail)
    config = {**SMALL_TRAINING, "env": "PointMassEmptyEnv-v1", "num_workers": 1}
    with pytest.raises(FloatingPointError, match="in here"):
        train(Config(**config, out=str(tmp_path / "run")))
    assert threading.active_count() == 1


def test_success_is_read_at_the_last_step():
    """An episode that reaches the goal and leaves it would count."""

    def to_the_goal(t, which, obs, goal):
        return (goal - obs) / 0.05

    def there_and_away_again(t, which, obs, goal):
        return to_the_goal(t, which, obs, goal) if t < 40 else -np.sign(goal)

    with ParallelEnvs("PointMassEmptyEnv-v1", 16, 1) as envs:
        envs.reset(0)
        episodes, success = run.rollout(envs, to_the_goal, 50)
        assert success.all()
        assert episodes["obs"].shape == (16, 51, 2) and episodes["action"].shape == (16, 50, 2)
        np.testing.assert_array_equal(episodes["obs"], episodes["achieved_goal"])
        episodes, success = run.rollout(envs, there_and_away_again, 50)
        reached = np.linalg.norm(episodes["obs"][:, 40] - episodes["desired_goal"], axis=1)
        assert np.all(reached < 0.05) and not success.any()


@pytest.mark.parametrize("workers", [1, 2, 4, 8])
def test_heads_act_in_their_own_environments(workers):
    """Several heads would act in one episode, and exploration would not be consistent."""
    agent, rng = random_agent(num_heads=4, obs_dim=2, goal_dim=2), np.random.default_rng(0)
    obs, goal = rng.normal(size=(8, 2)), rng.normal(size=(8, 2))
    each = [slice(i * 8 // workers, (i + 1) * 8 // workers) for i in range(workers)]

    def acted(heads):
        policy = run.acting_heads(agent, heads, 8)
        return np.concatenate([policy(0, which, obs[which], goal[which]) for which in each])

    for i, action in enumerate(acted(4)):
        k = i // 2
        expected = agent.act(obs[None, [i]], goal[None, [i]], slice(k, k + 1))
        np.testing.assert_allclose(action, expected[0, 0], atol=1e-5)
    only_first = agent.act(obs[None], goal[None], slice(1))[0]
    np.testing.assert_allclose(acted(1), only_first, atol=1e-5)


def test_exploration_noise():
    """Exploration would be of another size or share, or the same in several steps or rows."""
    steps, n = 4, 25_000

    def explored(noise, random_actions):
        rng = np.random.default_rng(0)
        still = SimpleNamespace(act=lambda obs, goal, heads: np.full((1, obs.shape[1], 2), 0.9))
        drawn = run.exploration(rng, (steps, n, 2), noise, random_actions)
        policy, rows = run.acting_heads(still, 1, n, drawn), np.zeros((n // 2, 2))
        halves = (slice(0, n // 2), slice(n // 2, n))
        return np.concatenate(
            [policy(t, half, rows, rows) for t in range(steps) for half in halves]
        )

    actions = explored(noise=0.2, random_actions=0.0)
    np.testing.assert_allclose(np.quantile(actions - 0.9, 0.25), -0.2 * 0.6745, atol=0.005)
    assert abs((actions == 1).mean() - 0.3085) < 0.01  # P(0.9 + 0.2 z > 1), clipped
    below = actions[actions < 1]
    assert len(np.unique(below)) > 0.99 * len(below)
    actions = explored(noise=0.0, random_actions=0.3)
    kept = (actions == 0.9).all(axis=1)
    assert abs(kept.mean() - 0.7) < 0.01
    assert np.all((actions != 0.9).any(axis=1) == ~kept)  # the whole action is replaced
    assert len(np.unique(actions[~kept, 0])) == (~kept).sum()
    np.testing.assert_allclose(np.quantile(actions[~kept], [0.25, 0.75]), [-0.5, 0.5], atol=0.02)


def test_the_same_seed_gives_the_same_rows_and_no_random_numbers_serve_twice(tmp_path, monkeypatch):
    """A result could not be repeated, or two seeds, epochs or purposes would not be independent."""
    used = []  # in the run under way: what for, and a seed or a generator's stream

    def spy(owner, name, purpose, place):
        function = getattr(owner, name)

        def noted(*args):
            x = args[place]  # a PCG64's increment tells one stream from all others
            stream = x if isinstance(x, int) else x.bit_generator.state["state"]["inc"]
            used.append((purpose, stream))
            return function(*args)

        monkeypatch.setattr(owner, name, noted)

    spy(ParallelEnvs, "reset", "environments", 1)
    spy(run, "exploration", "episodes", 0)
    spy(run, "score", "Algorithm 1", 3)
    spy(run, "update_her_buffer", "Algorithm 1", 4)
    spy(HERBuffer, "sample", "mini-batches", 2)
    config = {**SMALL_TRAINING, "env": "PointMassEmptyEnv-v1", "epochs": 2, "num_workers": 2}
    config["heads"] = 4
    streams = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        used.clear()
        train(Config(**config, seed=seed, out=str(tmp_path / name)))
        assert sum(purpose == "episodes" for purpose, _ in used) == 3 + 2  # at random, 2 and 2
        streams.append(set(used))
    a, b, c = (without_timing(tmp_path / name) for name in "abc")
    assert len(a) == 2 and a == b and a != c and streams[0] == streams[1]
    both = streams[0] | streams[2]  # of 2 seeds, 2 epochs: training and testing, and three more
    assert len(both) == len({stream for _, stream in both}) == 2 * 2 * (2 + 3)
    head = (tmp_path / "a" / "progress.csv").read_text().splitlines()[0]
    assert head == ",".join(COLUMNS)
    # 16 environments, 50 steps: once at random and 2 cycles, then 2 cycles
    assert [row["env_steps"] for row in a] == [3 * 800, 5 * 800]


@pytest.mark.parametrize(
    "options",
    [
        {"priority": "variance", "importance": "none"},
        {"priority": "variance", "importance": "inverse", "heads": 3, "temperature": 15.0},
        {"priority": "within-kind", "acting_head": "one"},
        {"heads": 1, "updates": 1, "scored_per_drawn": 4.0},
        {"scored_per_drawn": 0.0625, "her_buffer_capacity": 64},
        {"buffer_size": 800, "cycles": 4},
    ],
    ids=str,
)
def test_every_option_runs_to_the_end(options, tmp_path):
    """An ablation could not be run, a full buffer would stop a run, or a column would be empty."""
    config = {**SMALL_TRAINING, "env": "PointMassEmptyEnv-v1", "num_workers": 1, **options}
    (row,) = train(Config(**config, out=str(tmp_path / "run")))
    assert row.keys() == set(COLUMNS) and all(map(math.isfinite, row.values())), row
    assert threading.active_count() == 1


@pytest.mark.slow
def test_point_mass_is_learned_and_not_without_relabelling(tmp_path):
    """Nothing would be learned; or hindsight would not be what it is learned by."""
    config = {"env": "PointMassEmptyEnv-v1", "epochs": 1, "updates": 5, "batch_size": 64}
    config |= {"cycles": 20, "action_penalty": 0.1}  # with 1 it takes ten times as long
    (learned,) = train(Config(**config, out=str(tmp_path / "her")))
    assert learned["test_success_rate"] >= 0.9
    (control,) = train(Config(**config, relabel_ratio=0.0, out=str(tmp_path / "no")))
    assert control["test_success_rate"] < 0.1
