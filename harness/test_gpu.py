"""Tests of what a GPU needs, on the CPU, and on a GPU where there is one: against the classes that
these stand for."""

import itertools
from functools import partial

import numpy as np
import pytest
import torch

import harness.assemble as rooms
import run
from ensemble import EnsembleDDPG
from harness.gpu import EnsembleOnGPU, HERBufferOnGPU
from harness.testing import SMALL_TRAINING, main, without_timing
from run import Config
from vcp import IMPORTANCE, PRIORITIES, HERBuffer

DEVICES = ["cpu", *["cuda"] * torch.cuda.is_available()]
SIZES = {"obs_dim": 5, "goal_dim": 2, "action_dim": 3, "gamma": 0.9, "num_heads": 4}


def mini_batch(rng, rows):
    sizes = {"obs": 5, "next_obs": 5, "goal": 2, "action": 3}
    batch = {name: rng.uniform(-1, 1, (rows, n)).astype(np.float32) for name, n in sizes.items()}
    batch["reward"] = -rng.integers(2, size=rows).astype(np.float32)
    return {**batch, "hindsight": rng.random(rows) < 0.8}


def weights(agent):
    return [p.detach().cpu() for net in agent._networks for p in net.trunk + net.stacks]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("together", [1, 2, 4])
def test_the_updates_are_those_of_the_ensemble(device, together):
    """10 steps of each head, more than are taken before the capture, and the targets between. Later
    the roundings grow, where a target passes a bound or a unit stops firing."""
    plain, ours = EnsembleDDPG(**SIZES), EnsembleOnGPU(**SIZES, device=device)
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(100, 7))
    for agent in (plain, ours):
        agent.normalizer.update(seen)
    for i in range(10):
        for first in range(0, 4, together):
            batches = [
                {**mini_batch(rng, 32), "weight": rng.random(32).astype(np.float32)}
                for _ in range(together)
            ]
            heads = range(first, first + together)
            expected, losses = (agent.update_heads(heads, batches) for agent in (plain, ours))
            torch.testing.assert_close(losses.cpu(), expected, rtol=1e-4, atol=1e-5)
        if i % 4 == 3:
            plain.update_targets()
            ours.update_targets()
    for expected, p in zip(weights(plain), weights(ours), strict=True):
        difference = (p - expected).abs()  # a step of Adam is 1e-3
        assert difference.mean() < 1e-6 and difference.max() < 1e-3
    variances = [agent.q_variance(seen[:, :5], seen[:, :3], seen[:, 5:]) for agent in (plain, ours)]
    np.testing.assert_allclose(*variances, rtol=1e-2)


@pytest.mark.parametrize("device", DEVICES)
def test_it_acts_with_the_actors_as_they_are(device, tmp_path):
    """After a step, after what the normaliser saw, and after loading."""
    agent, rng = EnsembleOnGPU(**SIZES, device=device), np.random.default_rng(0)
    obs, goal = rng.normal(size=(4, 6, 5)), rng.normal(size=(4, 6, 2))
    agent.normalizer.update(rng.normal(size=(100, 7)))

    def check():
        with torch.no_grad():
            state = agent._state(obs, goal)
            expected = agent.actor.all_heads(state).cpu().numpy()
        np.testing.assert_allclose(agent.act(obs, goal), expected, atol=1e-5)
        some = agent.act(obs[1:3], goal[1:3], slice(1, 3))
        np.testing.assert_allclose(some, expected[1:3], atol=1e-5)
        return expected

    def train():
        ones = {"weight": np.ones(8, np.float32)}
        agent.update_heads(range(4), [{**mini_batch(rng, 8), **ones} for _ in range(4)])

    acted = [check()]
    train()
    saved = agent.state_dict()
    torch.save(saved, tmp_path / "saved.pt")
    acted.append(check())
    agent.normalizer.update(rng.normal(size=(100, 7)) + 1)
    acted.append(check())
    for _ in range(5):
        train()
    acted.append(check())
    agent.load_state_dict(torch.load(tmp_path / "saved.pt", map_location="cpu"))
    for _ in range(5):
        train()
    acted.append(check())
    assert all(abs(x - y).max() > 1e-4 for x, y in itertools.pairwise(acted))
    agent.load_state_dict(torch.load(tmp_path / "saved.pt", map_location="cpu"))
    check()
    agent.load_state_dict(EnsembleOnGPU(**SIZES, device=device, seed=1).state_dict())
    assert np.isfinite(check()).all()  # one that has seen and learned nothing


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("priority", PRIORITIES)
@pytest.mark.parametrize("importance", IMPORTANCE)
def test_it_draws_what_b_h_draws(device, priority, importance):
    """Also when it is full and the oldest are overwritten, and from a checkpoint of the other."""
    settings = (50, 3.0, priority, importance)
    plain, ours = HERBuffer(*settings), HERBufferOnGPU(*settings, at_once=3, device=device)
    rng = np.random.default_rng(0)
    draws = [np.random.default_rng(1) for _ in range(2)]
    for i in range(6):
        batch, variance = mini_batch(rng, 20), rng.exponential(size=20).astype(np.float32)
        for buffer in (plain, ours):
            buffer.add(batch, variance)
            buffer.update_priorities()
        if i == 3:
            saved = ours.state_dict()
            ours = HERBufferOnGPU(*settings, at_once=3, device=device)
            ours.load_state_dict(saved)
        assert plain.size == ours.size
        for _ in range(3):
            expected = plain.sample(16, draws[0])
            drawn = ours.sample(16, draws[1])
            assert expected.keys() == drawn.keys()
            for name, x in expected.items():
                np.testing.assert_allclose(drawn[name].cpu().numpy(), x, rtol=1e-6, err_msg=name)


@pytest.mark.parametrize("device", DEVICES)
def test_the_first_whose_cumulative_probability_is_above(device):
    """Of four equal ones: 0 is the first's, 1/4 the second's."""

    class Edge:
        def random(self, shape):
            return np.array([[0.0, 0.25, 0.75]])

    buffer = HERBufferOnGPU(4, 1.0, "uniform", at_once=1, device=device)
    rows = np.arange(4, dtype=np.float32)
    buffer.add({"obs": rows, "hindsight": rows > 1}, rows)
    buffer.update_priorities()
    assert buffer.sample(3, Edge())["obs"].tolist() == [0, 1, 3]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("variance", "error"),
    [
        ([0.1, np.nan], FloatingPointError),
        ([0.1, np.inf], FloatingPointError),
        ([0.1], ValueError),
        ([[0.1], [0.2]], ValueError),
        ([0.1, 0.2, 0.3], ValueError),
    ],
)
def test_what_b_h_refuses_is_refused(device, variance, error):
    """Each by the plain buffer too, there in one of its two steps."""
    for buffer in (HERBuffer(2, 1.0), HERBufferOnGPU(2, 1.0, at_once=1, device=device)):
        rows = np.zeros(3 if len(variance) == 3 else 2, np.float32)
        with pytest.raises(error):
            buffer.add({"obs": rows, "hindsight": rows > 1}, np.float32(variance))
            buffer.update_priorities()


@pytest.mark.parametrize("device", DEVICES)
def test_what_was_drawn_before_is_not_handed_out_afterwards(device):
    buffer, rng = HERBufferOnGPU(4, 1.0, at_once=2, device=device), np.random.default_rng(0)
    for i in range(3):
        rows = np.full(4, i, np.float32)
        buffer.add({"obs": rows, "hindsight": rows > 1}, rows)
        with pytest.raises(ValueError, match="call update_priorities"):
            buffer.sample(3, rng)
        buffer.update_priorities()
        assert buffer.sample(3, rng)["obs"].tolist() == [i, i, i]
        buffer.update_priorities()  # of two drawn at once one is left
        state = rng.bit_generator.state
        assert (
            buffer.sample(3, rng)["obs"].tolist() == [i, i, i] and rng.bit_generator.state != state
        )


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("together", [1, 4])
@pytest.mark.parametrize("method", ["vcp", "her"])
def test_a_run_is_the_one_of_the_cpu(device, together, method, tmp_path, monkeypatch):
    """Two epochs, the second one resumed; the CPU can go on with what it leaves."""
    common = {**SMALL_TRAINING, "env": "PointMassEmptyEnv-v1", "method": method, "epochs": 2}
    common |= {"heads": 4, "heads_at_once": together, "num_workers": 1}
    run.train(Config(**common, out=str(tmp_path / "cpu"), device="cpu"))
    if device == "cpu":
        monkeypatch.setattr(rooms, "EnsembleDDPG", EnsembleOnGPU)
        ours = partial(HERBufferOnGPU, at_once=4, device="cpu")
        monkeypatch.setattr(rooms, "HERBuffer", ours)
    config = {**common, "out": str(tmp_path / "gpu"), "device": device}
    run.train(Config(**{**config, "epochs": 1}))
    run.train(Config(**config), resume=True)
    both = [without_timing(tmp_path / name) for name in ("cpu", "gpu")]
    for row, its in zip(*both, strict=True):
        for name, x in row.items():
            np.testing.assert_allclose(its[name], x, rtol=0.02, atol=1e-3, err_msg=name)
    monkeypatch.undo()
    main([f"--resume={tmp_path / 'gpu'}", "--epochs=3", "--device=cpu"])
