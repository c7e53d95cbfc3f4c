"""Tests of the methods that VCP is compared with: by hand, by brute force, by exact probabilities.
What they share with VCP (relabelling, updates, runs) is tested in test_vcp.py."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest

import run
from baselines.cher import CHER, coverage, select
from baselines.dtgsh import DTGSH, choose_eigenvectors, sample_k_dpp, trajectory_diversity
from baselines.her import HERReplay
from baselines.herebp import EPSILON, HEREBP, trajectory_energy
from ensemble import EnsembleDDPG
from harness import settings
from harness.assemble import make_replay
from harness.tasks import PAPER_ENVS, examine
from harness.testing import (
    SMALL_TRAINING,
    assert_frequencies,
    exact_reward,
    numbered_episodes,
    without_timing,
)
from harness.workers import ParallelEnvs
from her import EpisodeBuffer
from run import Config, train
from vcp import HERBuffer, update_her_buffer

DT, G = 0.04, 9.81
OTHERS = ["her", "herebp", "cher", "dtgsh"]


def stored(achieved_goal, ratio=0.6, reward_fn=exact_reward):
    """B_o with these achieved goals, (N, T+1, G); obs and action say which episode and step."""
    n, steps, goal_dim = achieved_goal.shape
    episodes = {**numbered_episodes(n, steps - 1, goal_dim), "achieved_goal": achieved_goal}
    buffer = EpisodeBuffer(n * (steps - 1), steps - 1, 2, goal_dim, 2, ratio, reward_fn)
    buffer.add(episodes, np.random.default_rng(0))
    return buffer


# ---------------------------------------------------------------------------------------- HER


def hindsight_frequencies(batch, n, horizon):
    """How often each (episode, step, goal's step) was drawn, and its probability in HER: the goal's
    step t' is one of t+1..T with probability 0.6, and -1, the episode's own goal, with 0.4."""
    e, t = batch["obs"].T.astype(int) // 10
    later = batch["goal"][:, 1].astype(int)
    later = np.where(later < 0, np.where(later == -1 - e, -1, -2), later)  # -2: another episode's
    counts, probabilities = [], []
    for episode, step in itertools.product(range(n), range(horizon)):
        here = (e == episode) & (t == step)
        for goal_step in (-1, *range(step + 1, horizon + 1)):
            counts.append(np.sum(here & (later == goal_step)))
            share = 0.4 if goal_step == -1 else 0.6 / (horizon - step)
            probabilities.append(share / (n * horizon))
    assert np.sum(counts) == len(e)  # nothing else was drawn
    return counts, probabilities


def test_vcp_without_prioritization_samples_like_her():
    """Sections 5.6 and 5.9: VCP without prioritization is HER with the ensemble."""
    n, horizon, rng = 3, 5, np.random.default_rng(0)
    buffer = EpisodeBuffer(n * horizon, horizon, 2, 2, 2, 0.6, exact_reward)
    buffer.add(numbered_episodes(n, horizon), rng)

    her = HERReplay(buffer, at_once=5)
    batches = [her.sample(2_000, rng) for _ in range(15)]
    drawn = {name: np.concatenate([b[name] for b in batches]) for name in batches[0]}
    assert_frequencies(*hindsight_frequencies(drawn, n, horizon))
    assert (drawn["weight"] == 1).all()

    agent = EnsembleDDPG(2, 2, 2, gamma=0.98, num_heads=2)
    her_buffer = HERBuffer(300_000, temperature=9, priority="uniform")
    update_her_buffer(her_buffer, buffer, agent.q_variance, 300_000, rng)
    drawn = her_buffer.sample(30_000, rng)
    assert_frequencies(*hindsight_frequencies(drawn, n, horizon))
    np.testing.assert_allclose(drawn["weight"], 1, rtol=1e-6)


def test_what_was_drawn_without_new_episodes_is_dropped():
    buffer = EpisodeBuffer(20, 5, 2, 2, 2, 0.8, exact_reward)
    rng = np.random.default_rng(0)
    her = HERReplay(buffer, at_once=4)
    her.new_episodes(buffer.add(numbered_episodes(1, 5), rng))
    assert not her.sample(100, rng)["obs"][:, 0].any()
    assert len({her.sample(100, rng)["obs"].tobytes() for _ in range(6)}) == 6
    her.new_episodes(buffer.add(numbered_episodes(3, 5), rng))
    assert set(her.sample(100, rng)["obs"][:, 0]) == {0, 10, 20}


# ---------------------------------------------------------------------------------------- HEREBP


def line(*points):
    return np.array([points], dtype=float)


def path(speeds, axis=0, goal_dim=3):
    """(1, T+1, G): moves by speeds[t]·dt along an axis."""
    x = np.zeros((1, len(speeds) + 1, goal_dim))
    x[0, 1:, axis] = np.cumsum(speeds) * DT
    return x


def turning(angles, axis=(0, 0, 1)):
    """Poses at the origin turned by these angles about an axis, w first."""
    half = np.asarray(angles) / 2
    x = np.zeros((1, len(half), 7))
    x[0, :, 3] = np.cos(half)
    x[0, :, 4:] = np.sin(half)[:, None] * np.asarray(axis)
    return x


def test_energies_by_hand():
    def energy(x, **kwargs):
        return trajectory_energy(x, DT, **kwargs)[0]

    assert energy(path([0, 0, 0])) == 0
    # sliding: ½ v² once; braking gives nothing back, and a new start counts again
    assert energy(path([0.5] * 10)) == pytest.approx(0.125)
    assert energy(path([0.5, 0.5, 0, 0.5, 0.3])) == pytest.approx(0.25)
    assert energy(path([0.3, 0.4], axis=1, goal_dim=2)) == pytest.approx(0.08)
    # lifted at a constant speed: ½ v² + g h; let down again: no more
    lift = path([0.25] * 8, axis=2)
    assert energy(lift) == pytest.approx(0.03125 + G * 0.08)
    up_and_down = np.concatenate([lift, lift[:, ::-1]], axis=1)
    assert energy(up_and_down) == pytest.approx(0.03125 + G * 0.08)
    # Free fall turns height into speed. Between steps the mean speed is g (t - ½) dt, so that
    # E_t = ½ (g dt)² ((t - ½)² - t²), which falls with t: nothing is gained.
    t = np.arange(12) * DT
    fall = np.zeros((1, 12, 3))
    fall[0, :, 2] = 1 - G * t**2 / 2
    assert energy(fall) == 0
    # ... but in a plane there is no height, and the speed is all there is
    flat = fall[..., [0, 2]]
    assert energy(flat) == pytest.approx(0.5 * (G * DT * 10.5) ** 2)
    # five fingertips: the sum over them
    assert energy(np.tile(lift, 5)) == pytest.approx(5 * energy(lift))
    # at most so much for each step
    assert energy(path([1, 0, 1]), most_per_step=0.2) == pytest.approx(0.4)


@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0), (0, 1, 0), (0.6, 0, 0.8)])
def test_energy_of_a_rotation(axis):
    # 0.1 rad a step, past ±π and past pitch π/2: ½ ω², once
    angles = np.arange(60) * 0.1
    poses = turning(angles, axis)
    expected = 0.5 * (0.1 / DT) ** 2
    assert trajectory_energy(poses, DT)[0] == pytest.approx(expected)
    poses[0, 20:, 3:] *= -1  # the same orientations
    assert trajectory_energy(poses, DT)[0] == pytest.approx(expected)


def test_energies_of_any_episodes():
    rng = np.random.default_rng(0)
    for goal_dim in (2, 3, 6, 7, 15):
        x = rng.normal(0, 0.1, (4, 9, goal_dim)).cumsum(axis=1)
        if goal_dim == 7:
            x[..., 3:] /= np.linalg.norm(x[..., 3:], axis=-1, keepdims=True)
        for most in (0.5, math.inf):
            expected = []
            for episode in x:
                total, last = 0.0, 0.0
                for t in range(1, 9):
                    now, before = episode[t], episode[t - 1]
                    moving = 3 if goal_dim == 7 else goal_dim
                    e = sum(((now[i] - before[i]) / DT) ** 2 / 2 for i in range(moving))
                    if goal_dim != 2:
                        e += sum(G * (now[i] - episode[0][i]) for i in range(2, moving, 3))
                    if goal_dim == 7:
                        cosine = min(abs(sum(now[3:] * before[3:])), 1)
                        e += (2 * math.acos(cosine) / DT) ** 2 / 2
                    total += min(max(e - last, 0), most)
                    last = e
                expected.append(total)
            np.testing.assert_allclose(trajectory_energy(x, DT, most), expected, rtol=1e-9)


def test_herebp_draws_episodes_by_their_energy():
    speeds = np.array([0, 0.2, 0.5, 1])
    achieved = np.concatenate([path([v] * 5) for v in speeds])
    buffer, rng = stored(achieved), np.random.default_rng(0)
    replay = HEREBP(buffer, env_name="FetchPush-v1", dt=DT, temperature=3)
    for slots in ([0, 1], [2, 3]):  # two collections
        replay.new_episodes(np.array(slots))
    energy = np.minimum(speeds**2 / 2, 0.5) + EPSILON
    expected = energy ** (1 / 3.01) / np.sum(energy ** (1 / 3.01))
    batch = replay.sample(100_000, rng)
    e, t = batch["obs"].T.astype(int) // 10
    assert_frequencies(np.bincount(e, minlength=4), expected)
    assert_frequencies(np.bincount(t, minlength=5), np.full(5, 0.2))
    assert abs(batch["hindsight"].mean() - 0.6) < 0.01
    later = np.round((batch["goal"] - achieved[e, t])[:, 0] / (speeds[e] * DT + 1e-9))
    assert ((later >= 1) & (later <= 5 - t))[batch["hindsight"] & (e > 0)].all()
    # an episode that is overwritten loses its energy
    slots = buffer.add(
        {name: x[:1] for name, x in buffer.episodes.items()}, np.random.default_rng(0)
    )
    replay.new_episodes(slots)
    assert replay.energy[slots] == trajectory_energy(achieved[:1], DT)


def test_herebp_where_nothing_moves():
    replay = HEREBP(stored(np.ones((3, 6, 3))), env_name="FetchPush-v1", dt=DT)
    replay.new_episodes(np.arange(3))
    e = replay.sample(9_000, np.random.default_rng(0))["obs"][:, 0].astype(int) // 10
    assert_frequencies(np.bincount(e, minlength=3), np.full(3, 1 / 3))


# ---------------------------------------------------------------------------------------- CHER


def nearest_neighbours(goal):
    """For each goal the index of the nearest other one and exp(-d²/mean(d)²), slowly."""
    m = len(goal)
    pairs = [
        min((np.linalg.norm(goal[i] - goal[j]), j) for j in range(m) if j != i) for i in range(m)
    ]
    mean = np.mean([d for d, _ in pairs])
    return [j for _, j in pairs], [math.exp(-((d / mean) ** 2)) if mean else 1.0 for d, _ in pairs]


def diversity(chosen, neighbour, similarity):
    """The facility location Σ_i max over j chosen of sim_ij, as it is written down."""
    links = zip(neighbour, similarity, strict=True)
    return sum(max([s if n == j else 0.0 for j in chosen], default=0.0) for n, s in links)


def test_coverage_is_what_a_goal_adds_to_any_selection():
    rng = np.random.default_rng(0)
    goal = rng.normal(size=(3, 7, 3)).astype(np.float32)
    for u in range(3):
        links = nearest_neighbours(goal[u].astype(float))
        gain = coverage(goal)[u]
        for size in range(4):
            for chosen in itertools.combinations(range(7), size):
                for j in set(range(7)) - set(chosen):
                    added = diversity([*chosen, j], *links) - diversity(chosen, *links)
                    assert added == pytest.approx(gain[j], abs=1e-9)


def test_coverage_of_goals_that_are_equal():
    np.testing.assert_array_equal(coverage(np.full((1, 5, 3), 1.34, np.float32)).sum(), 5)
    some = np.array([[[0.0, 0], [0, 0], [3, 0], [3, 1]]])  # d = 0 0 1 1, mean ½
    expected = [1, 1, math.exp(-4), math.exp(-4)]
    np.testing.assert_allclose(coverage(some)[0], expected)


def test_cher_selects_like_a_brute_force_greedy():
    rng = np.random.default_rng(0)
    sets, m, k = 20, 9, 7
    goal, achieved = rng.normal(size=(2, sets, m, 3))
    proximity = rng.uniform(0.1, 2, sets)
    chosen = select(goal, achieved, k, proximity, np.random.default_rng(1))

    draws = np.random.default_rng(1)
    r = m - np.arange(k)
    places = [draws.integers(r - i, size=(sets, k)) for i in range(3)]
    differs = 0
    for u in range(sets):
        neighbour, similarity = nearest_neighbours(goal[u])
        remaining, taken = list(range(m)), []
        for s in range(k):
            # the i-th draw counts among the places that the draws before it left free
            free = list(range(len(remaining)))
            trio = [remaining[free.pop(places[i][u, s])] for i in range(3)]
            best, best_value = None, -math.inf
            for j in trio:
                now = diversity([*taken, j], neighbour, similarity)
                value = now - diversity(taken, neighbour, similarity)
                value -= proximity[u] * np.linalg.norm(goal[u, j] - achieved[u, j])
                if value > best_value:
                    best, best_value = j, value
            taken.append(best)
            place = remaining.index(best)
            remaining[place] = remaining[-1]
            remaining.pop()
        assert chosen[u].tolist() == taken
        differs += chosen[u].tolist() != sorted(chosen[u].tolist())
    assert differs


def test_cher_takes_the_best_of_three_different_ones():
    # goals on a ring, so that all cover alike; the distance to what was achieved ranks them
    sets, m = 60_000, 6
    corners = np.arange(m) * 2 * math.pi / m
    goal = np.stack([np.cos(corners), np.sin(corners)], axis=-1)[None].repeat(sets, axis=0)
    goal[:, ::2] *= 1.001  # pairs of neighbours
    achieved = goal + np.array([1.0, 0]) * np.arange(m)[:, None] * 100
    first = select(goal, achieved, 1, np.ones(sets), np.random.default_rng(0))[:, 0]
    # the best of 3 of 6 has rank i with C(5 - i, 2) / C(6, 3)
    expected = [math.comb(5 - i, 2) / 20 for i in range(m)]
    assert_frequencies(np.bincount(first, minlength=m), expected)
    all_but_two = select(goal[:50], achieved[:50], m - 2, np.ones(50), np.random.default_rng(0))
    assert all(len(set(chosen)) == m - 2 for chosen in all_but_two.tolist())


def test_cher_weighs_proximity_more_and_more_and_starts_again(monkeypatch):
    seen = []

    def spy(goal, achieved, selected, proximity, *rest):
        seen.append((goal, achieved, proximity))
        return select(goal, achieved, selected, proximity, *rest)

    monkeypatch.setattr("baselines.cher.select", spy)
    buffer = stored(numbered_episodes(4, 50)["achieved_goal"], ratio=0.2)
    replay = CHER(buffer, env_name="FetchPush-v1", heads=2, updates=6, at_once=4)
    rng = np.random.default_rng(0)
    batches = [replay.sample(8, rng) for _ in range(16)]
    tau = [round(math.log(x) / math.log(1.0001)) for _, _, p in seen for x in p]
    assert tau == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 0, 0, 1, 1]
    candidates = np.concatenate([goal for goal, *_ in seen]).reshape(-1, 2)
    assert abs((candidates[:, 0] >= 0).mean() - 0.2) < 0.15  # 256 of them; 5 sigma
    goal, achieved, _ = seen[0]
    assert goal.shape == achieved.shape == (4, 16, 2)
    for u, batch in enumerate(batches[:4]):  # drawn together, used in the order of their τ
        # the achieved goal is the one of the step itself, not of the next
        pairs = {(*g, *a) for g, a in zip(goal[u].tolist(), achieved[u].tolist(), strict=True)}
        ours = np.concatenate([batch["goal"], batch["obs"] / 10], axis=1).tolist()
        assert {tuple(row) for row in ours} <= pairs and batch["reward"].shape == (8,)
    rewards = np.concatenate([b["reward"] for b in batches])
    nexts = np.concatenate([b["next_obs"] for b in batches]) / 10
    goals = np.concatenate([b["goal"] for b in batches])
    np.testing.assert_array_equal(rewards, exact_reward(nexts, goals))
    np.testing.assert_array_equal(
        np.concatenate([b["hindsight"] for b in batches]), goals[:, 0] >= 0
    )


@pytest.mark.parametrize("method", [CHER, DTGSH])
def test_rotation_tasks_look_at_the_orientation_alone(method):
    extra = {"heads": 1, "updates": 1} if method is CHER else {}
    for env_name in PAPER_ENVS:
        replay = method(stored(np.ones((1, 6, 7))), env_name=env_name, **extra)
        assert replay.goal_part == slice(3 if "Rotate" in env_name else 0, None)


# ---------------------------------------------------------------------------------------- DTGSH


def test_trajectory_diversity_against_determinants():
    rng = np.random.default_rng(0)
    for goal_dim in (2, 3, 7, 15):
        a = rng.normal(size=(4, 11, goal_dim))
        a[1, 4] = 0  # at the origin
        a[2] = a[2, :1]  # never moves
        expected = []
        for episode in a:
            lengths = [np.linalg.norm(x) for x in episode]
            unit = [x / n if n else x for x, n in zip(episode, lengths, strict=True)]
            pairs = [np.stack(unit[t : t + 2]) for t in range(10)]
            expected.append(sum(np.linalg.det(p @ p.T) for p in pairs))
        np.testing.assert_allclose(trajectory_diversity(a), expected, atol=1e-9)
        np.testing.assert_allclose(trajectory_diversity(a, 3), np.minimum(expected, 3), atol=1e-9)
    assert trajectory_diversity(np.array([[[1.0, 0], [0, 1], [0, 5]]])) == 1  # 90°, then 0°


def test_k_dpp_against_the_exact_probabilities():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(6, 2))
    kernel = np.exp(-np.square(x[:, None] - x[None]).sum(axis=-1) / 2)
    for k in (1, 3, 6):
        subsets = list(itertools.combinations(range(6), k))
        determinants = np.array([np.linalg.det(kernel[np.ix_(s, s)]) for s in subsets])
        drawn = sample_k_dpp(np.tile(kernel, (40_000, 1, 1)), k, rng)
        index = {s: i for i, s in enumerate(subsets)}
        counts = np.bincount(
            [index[tuple(sorted(s))] for s in drawn.tolist()], minlength=len(index)
        )
        assert_frequencies(counts, determinants / determinants.sum())  # Σ det(L_S) = e_k(λ)


def test_eigenvectors_are_chosen_where_products_underflow():
    values = [Fraction(1), *[Fraction(i, 10**175) for i in (50, 1, 2, 3, 4)]]
    k, rng = 4, np.random.default_rng(0)
    subsets = list(itertools.combinations(range(6), k))
    products = [math.prod(values[i] for i in s) for s in subsets]
    expected = [float(p / sum(products)) for p in products]
    chosen = choose_eigenvectors(np.tile([float(v) for v in values], (50_000, 1)), k, rng)
    index = {s: i for i, s in enumerate(subsets)}
    counts = np.bincount(
        [index[tuple(np.flatnonzero(row))] for row in chosen], minlength=len(subsets)
    )
    never = np.array(expected) < 1e-100
    assert never.sum() == 5 and counts[never].sum() == 0
    assert_frequencies(counts[~never], np.array(expected)[~never])


def test_k_dpp_of_goals_that_are_close_or_equal():
    rng = np.random.default_rng(0)
    close = rng.uniform(-0.15, 0.15, (4, 100, 3))  # Fetch's table: about 40 to 65 eigenvalues count
    close[1, 50:] = close[1, :50]
    close[2] = 0
    kernel = np.exp(-np.square(close[:, :, None] - close[:, None]).sum(axis=-1) / 0.5)
    items = sample_k_dpp(kernel, 64, rng)
    assert all(len(set(s)) == 64 for s in items.tolist())
    # with 50 pairs of equal goals, 48.7 of them on average, 43.6 by 64 drawn at random
    pairs = sample_k_dpp(np.repeat(kernel[1:2], 40, axis=0), 64, rng) % 50
    assert np.mean([len(set(p)) for p in pairs.tolist()]) > 48
    ones = sample_k_dpp(np.ones((20_000, 5, 5)), 2, rng)
    assert_frequencies(np.bincount(ones.reshape(-1), minlength=5), np.full(5, 0.2))


def test_dtgsh_draws_episodes_by_their_diversity(monkeypatch):
    # episodes that turn by 0, 1, 2 and 3 right angles
    corners = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]], dtype=np.float32)
    achieved = np.stack([corners[[0, *[min(t, n) for t in range(1, 6)]]] for n in range(4)])
    buffer, kernels = stored(achieved), []

    def first(kernel, k, *rest):
        kernels.append(kernel)
        return np.tile(np.arange(k), (len(kernel), 1))

    monkeypatch.setattr("baselines.dtgsh.sample_k_dpp", first)
    replay = DTGSH(buffer, env_name="PointMassEmptyEnv-v1", at_once=400)
    for slots in ([0, 1], [2, 3]):  # two collections
        replay.new_episodes(np.array(slots))
    rng = np.random.default_rng(0)
    batches = [replay.sample(64, rng) for _ in range(400)]
    drawn = {name: np.concatenate([b[name] for b in batches]) for name in batches[0]}
    e, t = drawn["obs"].T.astype(int) // 10
    assert_frequencies(np.bincount(e, minlength=4), np.array([0, 1, 2, 3]) / 6)
    assert_frequencies(np.bincount(t, minlength=5), np.full(5, 0.2))
    assert abs(drawn["hindsight"].mean() - (1 - 64 * 0.4 / 100)) < 0.01
    own = (drawn["goal"].T == -1 - e).all(axis=0)  # corners are no such goals
    np.testing.assert_array_equal(drawn["hindsight"], ~own)
    (kernel,) = kernels
    assert kernel.shape == (400, 100, 100)
    first = batches[0]["goal"].astype(float)
    apart = np.square(first[:, None] - first[None]).sum(axis=-1)
    np.testing.assert_allclose(kernel[0, :64, :64], np.exp(-apart / (2 * 0.5**2)), rtol=1e-9)


def test_dtgsh_where_nothing_moves():
    replay = DTGSH(stored(np.ones((3, 6, 3))), env_name="FetchPush-v1")
    replay.new_episodes(np.arange(3))
    batch = replay.sample(64, np.random.default_rng(0))
    assert len(set(batch["obs"][:, 0])) == 3 and np.isfinite(batch["reward"]).all()


def test_limits_of_the_originals():
    one = np.ones((1, 6, 3))
    for name, sigma, most in (
        ("FetchPush-v1", 0.5, 0.001),
        ("HandReach-v0", 0.1, math.inf),
        ("Reacher-v2", 0.5, math.inf),
    ):
        replay = DTGSH(stored(one), env_name=name)
        assert (replay.sigma, replay.most) == (sigma, most)
        replay = HEREBP(stored(one), env_name=name, dt=DT)
        assert replay.exponent == 1 / 1.01
        assert replay.settings[1] == {"F": 0.5, "H": 2.5}.get(name[0], math.inf)


# ---------------------------------------------------------------------------------------- runs


@pytest.mark.parametrize("name", PAPER_ENVS)
def test_every_method_in_each_of_the_sixteen(name):
    task, rng = examine(name), np.random.default_rng(0)
    dims = (task.obs_dim, task.goal_dim, task.action_dim)
    agent = EnsembleDDPG(*dims, gamma=0.98, num_heads=1)
    buffer = EpisodeBuffer(1000, 50, *dims, 0.8, task.reward_fn)
    with ParallelEnvs(name, 2, 1) as envs:
        envs.reset(0)
        episodes, _ = run.rollout(envs, lambda *_: rng.uniform(-1, 1, (2, task.action_dim)), 50)
    slots = buffer.add(episodes, rng)
    for method in OTHERS:
        config = settings.complete(Config(env=name, method=method, updates=4, heads=1))
        replay = make_replay(config, task, buffer)
        replay.new_episodes(slots)
        batch = replay.sample(64, rng)
        assert {x.shape[0] for x in batch.values()} == {64}
        assert all(np.isfinite(x).all() for x in batch.values())
        assert set(np.unique(batch["reward"])) <= {-1.0, 0.0}
        assert agent.update_head(0, batch).isfinite().all()


def tiny(method, heads, **others):
    small = {**SMALL_TRAINING, "env": "PointMassEmptyEnv-v1", "num_workers": 1, **others}
    return {**small, "method": method, "heads": heads}


@pytest.mark.parametrize("method", OTHERS)
def test_the_smallest_mini_batches(method, tmp_path):
    least = 2 if method == "cher" else 1
    train(Config(**tiny(method, 1, batch_size=least), out=str(tmp_path / "run")))


@pytest.mark.parametrize("heads", [1, 16])
@pytest.mark.parametrize("method", OTHERS)
def test_a_run_of_every_method(method, heads, tmp_path):
    (row,) = train(Config(**tiny(method, heads), out=str(tmp_path / "run")))
    assert all(math.isfinite(value) for value in row.values()), row
    assert row["env_steps"] == 3 * 16 * 50
    assert (row["variance_hindsight"] == 0) == (heads == 1)


@pytest.mark.parametrize("method", OTHERS)
def test_a_resumed_run_of_every_method_equals_an_uninterrupted_one(method, tmp_path):
    config = {**tiny(method, 2), "epochs": 3, "eval_episodes": 4}
    train(Config(**config, out=str(tmp_path / "whole")))
    train(Config(**{**config, "epochs": 2}, out=str(tmp_path / "parts")))
    train(Config(**config, out=str(tmp_path / "parts")), resume=True)
    rows = without_timing(tmp_path / "whole")
    assert len(rows) == 3 and rows == without_timing(tmp_path / "parts")


def test_the_heads_get_mini_batches_of_their_own(tmp_path, monkeypatch):
    batches = []

    def spy(self, heads, drawn, map):
        pairs = zip(heads, drawn, strict=True)
        batches.extend((k, batch["obs"].tobytes()) for k, batch in pairs)
        return update(self, heads, drawn, map)

    update = EnsembleDDPG.update_heads
    monkeypatch.setattr(EnsembleDDPG, "update_heads", spy)
    for method in OTHERS:
        batches.clear()
        train(Config(**tiny(method, 3), out=str(tmp_path / method)))
        assert [k for k, _ in batches] == 2 * 2 * [0, 1, 2]
        assert len({b for _, b in batches}) == len(batches)


def test_dtgsh_keeps_batch_64_and_the_amount_of_data():
    for env in PAPER_ENVS:
        ours, theirs = (settings.paper_schedule(env, m) for m in ("dtgsh", "her"))
        assert ours["batch_size"] == 64 and ours["cycles"] == theirs["cycles"]
        used = [s["batch_size"] * s["updates"] for s in (ours, theirs)]
        assert used[0] == used[1]
