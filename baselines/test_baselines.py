"""Tests of the methods that VCP is compared with, against brute force and exact probabilities.

What they share with VCP (relabelling, updates, runs) is tested in test_vcp.py. The line below a
test's name says what would be wrong if the test failed.
"""

import itertools
import math
from collections import Counter
from fractions import Fraction
from functools import partial

import numpy as np
import pytest

from baselines.cher import CHER, coverage, select
from baselines.dtgsh import DTGSH, choose_eigenvectors, sample_k_dpp, trajectory_diversity
from baselines.her import HERReplay
from baselines.herebp import HEREBP, trajectory_energy
from ensemble import EnsembleDDPG
from harness import settings
from harness.tasks import PAPER_ENVS
from harness.testing import (
    SMALL_TRAINING,
    assert_drawn_as_in_her,
    assert_frequencies,
    assert_whole,
    exact_reward,
    numbered_episodes,
    without_timing,
)
from her import EpisodeBuffer
from run import Config, train
from vcp import HERBuffer, update_her_buffer

DT, G = 0.04, 9.81
OTHERS = ["her", "herebp", "cher", "dtgsh"]


def stored(achieved_goal, ratio=0.6):
    """B_o with these achieved goals, (N, T+1, G); obs and action say which episode and step."""
    n, steps, goal_dim = achieved_goal.shape
    episodes = {**numbered_episodes(n, steps - 1, goal_dim), "achieved_goal": achieved_goal}
    buffer = EpisodeBuffer(n * (steps - 1), steps - 1, 2, goal_dim, 2, ratio, exact_reward)
    buffer.add(episodes, np.random.default_rng(0))
    return buffer


def drawn(replay, batch_size, times):
    """So many mini-batches, one after the other."""
    rng = np.random.default_rng(0)
    batches = [replay.sample(batch_size, rng) for _ in range(times)]
    return {name: np.concatenate([b[name] for b in batches]) for name in batches[0]}


# ---------------------------------------------------------------------------------------- HER


def test_vcp_without_prioritization_samples_like_her():
    """Sections 5.6 and 5.9 would compare with something else than HER with the ensemble."""
    buffer, rng = stored(numbered_episodes(3, 5)["achieved_goal"]), np.random.default_rng(0)
    her_buffer = HERBuffer(300_000, temperature=9, priority="uniform")
    update_her_buffer(her_buffer, buffer, lambda obs, *_: obs[:, 0], 300_000, rng)
    for replay in (HERReplay(buffer, at_once=5), her_buffer):
        batch = drawn(replay, 2_000, 15)
        assert_drawn_as_in_her(batch, n=3, horizon=5, ratio=0.6)
        np.testing.assert_allclose(batch["weight"], 1, rtol=1e-6)


@pytest.mark.parametrize(
    "method",
    [HERReplay, partial(HEREBP, dt=DT), partial(CHER, heads=1, updates=1), DTGSH],
)
def test_what_was_drawn_without_new_episodes_is_dropped(method):
    """New episodes would be replayed late or never, or the mini-batches of one draw be the same."""
    buffer, rng = EpisodeBuffer(20, 5, 2, 2, 2, 0.8, exact_reward), np.random.default_rng(0)
    task = {} if method is HERReplay else {"env_name": "PointMassEmptyEnv-v1"}
    replay = method(buffer, at_once=4, **task)
    replay.new_episodes(buffer.add(numbered_episodes(1, 5), rng))
    assert not replay.sample(100, rng)["obs"][:, 0].any()
    assert len({replay.sample(100, rng)["obs"].tobytes() for _ in range(6)}) == 6
    replay.new_episodes(buffer.add(numbered_episodes(3, 5), rng))
    assert replay.sample(100, rng)["obs"][:, 0].max() == 20  # of the newest
    assert replay.size == 4 * 100 == len(replay.data["obs"])


# ---------------------------------------------------------------------------------------- HEREBP


def energy(episode, most=math.inf):
    """HEREBP's energy of one episode (T+1, G), a step and a coordinate at a time."""
    goal_dim = episode.shape[1]
    moving = 3 if goal_dim == 7 else goal_dim
    total, last = 0.0, 0.0
    for before, now in itertools.pairwise(episode):
        e = sum(((now[i] - before[i]) / DT) ** 2 / 2 for i in range(moving))
        if goal_dim != 2:  # a plane has no height
            e += sum(G * (now[i] - episode[0][i]) for i in range(2, moving, 3))
        if goal_dim == 7:
            cosine = min(abs(sum(now[3:] * before[3:])), 1)
            e += (2 * math.acos(cosine) / DT) ** 2 / 2
        total += min(max(e - last, 0), most)
        last = e
    return total


@pytest.mark.parametrize("most", [0.5, math.inf])
@pytest.mark.parametrize("goal_dim", [2, 3, 6, 7, 15])
def test_energies_of_any_episodes(goal_dim, most):
    """Energy would be lost twice, counted beyond a step's limit, or of other coordinates."""
    x = np.random.default_rng(0).normal(0, 0.1, (4, 9, goal_dim)).cumsum(axis=1)
    if goal_dim == 7:
        x[..., 3:] /= np.linalg.norm(x[..., 3:], axis=-1, keepdims=True)
    x[3] = x[3, 0]  # never moves
    expected = [energy(episode, most) for episode in x]
    assert expected[3] == 0 if goal_dim != 7 else expected[3] < 1e-6
    np.testing.assert_allclose(trajectory_energy(x, DT, most), expected, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 1, 0), (0.6, 0, 0.8)])
def test_energy_of_a_rotation(axis):
    """A turn past ±π, or a quaternion of the other sign, would count as a jump."""
    half = np.arange(60) * 0.1 / 2  # 0.1 rad a step: ½ ω², once
    poses = np.zeros((1, 60, 7))
    poses[0, :, 3], poses[0, :, 4:] = np.cos(half), np.sin(half)[:, None] * np.array(axis)
    poses[0, 20:40, 3:] *= -1  # the same orientations
    assert trajectory_energy(poses, DT)[0] == pytest.approx(0.5 * (0.1 / DT) ** 2)


# ---------------------------------------------------------------------------------------- CHER


def nearest_neighbours(goal):
    """For each goal the index of the nearest other one and exp(-d²/mean(d)²), slowly."""
    m = len(goal)
    pairs = [
        min((np.linalg.norm(goal[i] - goal[j]), j) for j in range(m) if j != i) for i in range(m)
    ]
    mean = np.mean([d for d, _ in pairs])
    return [(j, math.exp(-((d / mean) ** 2)) if mean else 1.0) for d, j in pairs]


def diversity(chosen, links):
    """The facility location Σ_i max over j chosen of sim_ij, as it is written down."""
    return sum(max([s if n == j else 0.0 for j in chosen], default=0.0) for n, s in links)


@pytest.mark.parametrize(
    "goal",
    [
        np.random.default_rng(0).normal(size=(7, 3)),
        np.full((5, 3), 1.34),
        np.array([[0.0, 0], [0, 0], [3, 0], [3, 1]]),
    ],
    ids=["any", "all equal", "some equal"],
)
def test_coverage_is_what_a_goal_adds_to_any_selection(goal):
    """`select` would maximise something else than the diversity of CHER."""
    gain, links, m = coverage(np.float32(goal)[None])[0], nearest_neighbours(goal), len(goal)
    for size in range(4):
        for chosen in itertools.combinations(range(m), size):
            for j in set(range(m)) - set(chosen):
                added = diversity([*chosen, j], links) - diversity(chosen, links)
                assert added == pytest.approx(gain[j], abs=1e-6)


def greedy(goal, achieved, selected, proximity):
    """The probability of each sequence of chosen ones: of three different remaining candidates, all
    trios alike, the one that adds most."""
    links, distance = nearest_neighbours(goal), np.linalg.norm(goal - achieved, axis=1)
    sequences = {(): 1.0}
    for _ in range(selected):
        longer = Counter()
        for taken, p in sequences.items():
            value = {
                j: diversity([*taken, j], links) - proximity * distance[j]
                for j in set(range(len(goal))) - set(taken)
            }
            trios = [*itertools.combinations(value, 3)]
            for trio in trios:
                longer[*taken, max(trio, key=value.get)] += p / len(trios)
        sequences = longer
    return sequences


@pytest.mark.parametrize("proximity", [0.1, 0.5, 2.0])
def test_cher_selects_as_often_as_a_brute_force_greedy(proximity):
    """A candidate would be taken twice, too rarely, or for another value than CHER's."""
    rng = np.random.default_rng(int(10 * proximity))
    goal, achieved = rng.normal(size=(2, 6, 3))
    expected = greedy(goal, achieved, 4, proximity)
    many = np.full(20_000, proximity)
    chosen = select(*(np.tile(x, (20_000, 1, 1)) for x in (goal, achieved)), 4, many, rng)
    counts = Counter(map(tuple, chosen.tolist()))
    assert counts.keys() <= expected.keys() and len(expected) > 20
    assert_frequencies([counts[key] for key in expected], [*expected.values()])


def test_cher_weighs_proximity_more_and_more_and_starts_again(monkeypatch):
    """λ would grow K times as fast or for ever, or the mini-batch not be what was selected."""
    seen = []

    def spy(goal, achieved, selected, proximity, *rest):
        seen.append((goal, achieved, proximity))
        return select(goal, achieved, selected, proximity, *rest)

    monkeypatch.setattr("baselines.cher.select", spy)
    buffer = stored(numbered_episodes(4, 50)["achieved_goal"], ratio=0.2)
    replay = CHER(buffer, env_name="FetchPush-v1", heads=2, updates=6, at_once=4)
    batch = drawn(replay, 8, 16)
    tau = [round(math.log(x) / math.log(1.0001)) for _, _, p in seen for x in p]
    assert tau == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 0, 0, 1, 1]
    assert seen[0][0].shape == seen[0][1].shape == (4, 16, 2)  # of 4 mini-batches 8 are selected
    goal, achieved = (np.concatenate([call[i] for call in seen]) for i in (0, 1))
    assert abs((goal[..., 0] >= 0).mean() - 0.2) < 0.15  # 256 of them; 5 sigma
    # in the order of τ; the achieved goal is the one of the step itself, not of the next
    ours = np.hstack([batch["goal"], batch["obs"] / 10]).reshape(16, 8, 4).tolist()
    candidates = np.concatenate([goal, achieved], axis=2).tolist()
    assert all(row in candidates[u] for u in range(16) for row in ours[u])
    assert_whole(batch)


# ---------------------------------------------------------------------------------------- DTGSH


@pytest.mark.parametrize("goal_dim", [2, 3, 7, 15])
def test_trajectory_diversity_against_determinants(goal_dim):
    """Episodes would be drawn by something else than the determinants that DTGSH adds up."""
    a = np.random.default_rng(0).normal(size=(4, 11, goal_dim))
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


def counted(drawn, m, k):
    """How often each set of k of m items was drawn, in the order of itertools.combinations."""
    counts = Counter(map(tuple, np.sort(drawn, axis=1).tolist()))
    return [counts[s] for s in itertools.combinations(range(m), k)]


@pytest.mark.parametrize("k", [1, 3, 6])
def test_k_dpp_against_the_exact_probabilities(k):
    """Sets of goals would be drawn by something else than det(L_S)."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(6, 2))
    kernel = np.exp(-np.square(x[:, None] - x[None]).sum(axis=-1) / 2)
    subsets = itertools.combinations(range(6), k)
    determinants = np.array([np.linalg.det(kernel[np.ix_(s, s)]) for s in subsets])
    drawn = sample_k_dpp(np.tile(kernel, (40_000, 1, 1)), k, rng)
    assert_frequencies(counted(drawn, 6, k), determinants / determinants.sum())  # Σ = e_k(λ)


def test_eigenvectors_are_chosen_where_products_underflow():
    """Products of many small eigenvalues would be zero, and the sets be drawn alike."""
    values = [Fraction(1), *[Fraction(i, 10**175) for i in (50, 1, 2, 3, 4)]]
    products = [math.prod(s) for s in itertools.combinations(values, 4)]
    expected = np.array([float(p / sum(products)) for p in products])
    eigenvalues = np.tile([float(v) for v in values], (50_000, 1))
    chosen = choose_eigenvectors(eigenvalues, 4, np.random.default_rng(0))
    drawn = np.nonzero(chosen)[1].reshape(-1, 4)
    expected[expected < 1e-100] = 0
    assert np.count_nonzero(expected) == 10
    assert_frequencies(counted(drawn, 6, 4), expected)


def test_k_dpp_of_goals_that_are_close_or_equal():
    """Rounding would make eigenvalues of zero count, or draw an item twice."""
    rng = np.random.default_rng(0)
    close = rng.uniform(-0.15, 0.15, (4, 100, 3))  # Fetch's table: about 40 to 65 eigenvalues count
    close[1, 50:] = close[1, :50]
    close[2] = 0
    kernel = np.exp(-np.square(close[:, :, None] - close[:, None]).sum(axis=-1) / 0.5)
    assert all(len(set(s)) == 64 for s in sample_k_dpp(kernel, 64, rng).tolist())
    # with 50 pairs of equal goals, 48.7 of them on average, 43.6 by 64 drawn at random
    pairs = sample_k_dpp(np.repeat(kernel[1:2], 40, axis=0), 64, rng) % 50
    assert np.mean([len(set(p)) for p in pairs.tolist()]) > 48
    ones = sample_k_dpp(np.ones((20_000, 5, 5)), 2, rng)
    assert_frequencies(np.bincount(ones.reshape(-1), minlength=5), np.full(5, 0.2))


# ---------------------------------------------------------------------------------------- replays


@pytest.mark.parametrize(
    ("method", "priority", "hindsight"),
    [
        (partial(HEREBP, dt=DT, temperature=3), [1e-6, 625, 2500, 10_000], 0.6),
        (DTGSH, [0, 1, 2, 3], 1 - 64 * 0.4 / 100),
    ],
)
def test_episodes_are_drawn_by_their_energy_or_diversity(method, priority, hindsight, monkeypatch):
    """Episodes, steps or goals would be drawn otherwise, or of DTGSH the kernel be another one."""
    # episodes that turn by 0, 1, 2 and 3 right angles, at radii of 1, 1, 2 and 4
    corners = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]], dtype=np.float32)
    achieved = np.stack([corners[[min(t, n) for t in range(6)]] for n in range(4)])
    achieved *= np.float32([1, 1, 2, 4])[:, None, None]
    kernels = []

    def first(kernel, k, *rest):
        kernels.append(kernel)
        return np.tile(np.arange(k), (len(kernel), 1))

    monkeypatch.setattr("baselines.dtgsh.sample_k_dpp", first)
    replay = method(stored(achieved), env_name="PointMassEmptyEnv-v1", at_once=400)
    for slots in ([0, 1], [2, 3]):  # two collections
        replay.new_episodes(np.array(slots))
    batch = drawn(replay, 64, 400)
    e, t = batch["obs"].T.astype(int) // 10
    p = np.array(priority) if method is DTGSH else np.array(priority) ** (1 / 3.01)
    assert_frequencies(np.bincount(e, minlength=4), p / p.sum())
    assert_frequencies(np.bincount(t, minlength=5), np.full(5, 0.2))
    assert abs(batch["hindsight"].mean() - hindsight) < 0.02
    own = (batch["goal"].T == -1 - e).all(axis=0)  # corners are no such goals
    np.testing.assert_array_equal(batch["hindsight"], ~own)
    reached = (achieved[e] == batch["goal"][:, None]).all(axis=-1) & (np.arange(6) > t[:, None])
    np.testing.assert_array_equal(batch["hindsight"], reached.any(axis=1))
    for kernel in kernels:
        assert kernel.shape == (400, 100, 100)
        goal = batch["goal"][:64].astype(float)
        apart = np.square(goal[:, None] - goal[None]).sum(axis=-1)
        np.testing.assert_allclose(kernel[0, :64, :64], np.exp(-apart / (2 * 0.5**2)), rtol=1e-9)


@pytest.mark.parametrize("method", [partial(HEREBP, dt=DT), DTGSH])
def test_where_nothing_moves_all_episodes_are_alike(method):
    """A run would divide by zero before the object is first touched."""
    replay = method(stored(np.ones((3, 6, 3))), env_name="FetchPush-v1", at_once=50)
    replay.new_episodes(np.arange(3))
    e = drawn(replay, 64, 100)["obs"][:, 0].astype(int) // 10
    assert_frequencies(np.bincount(e, minlength=3), np.full(3, 1 / 3))


@pytest.mark.parametrize(
    ("env_name", "sigma", "most_diversity", "most_energy"),
    [
        ("FetchPush-v1", 0.5, 0.001, 0.5),
        ("HandReach-v0", 0.1, math.inf, 2.5),
        ("Reacher-v2", 0.5, math.inf, math.inf),
    ],
)
def test_settings_are_the_originals_by_the_tasks_name(env_name, sigma, most_diversity, most_energy):
    """A method would be compared with other settings than baselines/README.md says."""
    buffer = stored(np.float32(np.random.default_rng(0).normal(size=(4, 6, 3))))
    achieved = buffer.episodes["achieved_goal"]
    dtgsh, herebp = DTGSH(buffer, env_name=env_name), HEREBP(buffer, env_name=env_name, dt=DT)
    for replay in (dtgsh, herebp):
        replay.new_episodes(np.arange(4))
    assert (dtgsh.sigma, herebp.exponent) == (sigma, 1 / 1.01)
    np.testing.assert_allclose(dtgsh.diversity, trajectory_diversity(achieved, most_diversity))
    np.testing.assert_allclose(herebp.energy, trajectory_energy(achieved, DT, most_energy))


@pytest.mark.parametrize("method", [partial(CHER, heads=1, updates=1), DTGSH])
@pytest.mark.parametrize(
    ("env_name", "alone"),
    [
        ("HandManipulateEggRotate-v0", True),
        ("HandManipulateEggFull-v0", False),
        ("mine:RotateArm-v0", False),
    ],
)
def test_rotation_tasks_look_at_the_orientation_alone(method, env_name, alone):
    """The place of an object, which a rotation task does not ask for, would count."""
    achieved = np.float32(np.random.default_rng(0).normal(size=(4, 6, 7)))
    obs = []
    for scale in (1, 5):
        achieved[..., :3] *= scale
        replay = method(stored(achieved), env_name=env_name)
        replay.new_episodes(np.arange(4))
        obs.append(drawn(replay, 16, 4)["obs"])
    assert np.array_equal(*obs) == alone


# ---------------------------------------------------------------------------------------- runs


@pytest.mark.parametrize(  # goals of 15, 7, 3 and 2 numbers
    ("method", "env", "least"),
    [
        ("her", "HandReach-v0", 1),
        ("herebp", "HandManipulateBlockRotateZ-v0", 1),
        ("cher", "FetchPush-v1", 2),
        ("dtgsh", "Reacher-v2", 1),
    ],
)
def test_one_network_and_the_smallest_mini_batches(method, env, least, tmp_path):
    """HER and the others without an ensemble, Section 5.9, would stop or leave a column empty."""
    config = {**SMALL_TRAINING, "method": method, "env": env, "heads": 1, "batch_size": least}
    config |= {"episode_length": 10, "num_workers": 1, "out": str(tmp_path / "run")}
    (row,) = train(Config(**config))
    variance = row.pop("variance_hindsight"), row.pop("variance_original")
    assert all(x == 0 or math.isnan(x) for x in variance)  # NaN: none of a kind in the last batches
    assert all(map(math.isfinite, row.values())), row
    assert row["env_steps"] == 3 * 16 * 10


@pytest.mark.parametrize("method", OTHERS)
def test_an_ensemble_is_trained_and_a_resumed_run_equals_an_uninterrupted_one(
    method, tmp_path, monkeypatch
):
    """Heads would share a mini-batch, a column be empty, or a replay be lost in a checkpoint."""
    batches = []

    def spy(self, heads, drawn, map):
        pairs = zip(heads, drawn, strict=True)
        batches.extend((k, batch["obs"].tobytes()) for k, batch in pairs)
        return update(self, heads, drawn, map)

    update = EnsembleDDPG.update_heads
    monkeypatch.setattr(EnsembleDDPG, "update_heads", spy)
    config = {**SMALL_TRAINING, "env": "PointMassEmptyEnv-v1", "num_workers": 1, "epochs": 2}
    config |= {"method": method, "heads": 3}
    train(Config(**config, out=str(tmp_path / "whole")))
    assert [k for k, _ in batches] == 2 * 2 * 2 * [0, 1, 2]
    assert len({b for _, b in batches}) == len(batches)
    train(Config(**{**config, "epochs": 1}, out=str(tmp_path / "parts")))
    train(Config(**config, out=str(tmp_path / "parts")), resume=True)
    rows = without_timing(tmp_path / "whole")
    assert len(rows) == 2 and rows == without_timing(tmp_path / "parts")
    assert all(math.isfinite(x) for row in rows for x in row.values())
    assert rows[0]["variance_hindsight"] > 0


def test_dtgsh_keeps_batch_64_and_the_amount_of_data():
    """DTGSH would be compared after more or less data than the others have used."""
    for env in PAPER_ENVS:
        ours, theirs = (settings.paper_schedule(env, m) for m in ("dtgsh", "her"))
        assert ours["batch_size"] == 64 and ours["cycles"] == theirs["cycles"]
        used = [s["batch_size"] * s["updates"] for s in (ours, theirs)]
        assert used[0] == used[1]
