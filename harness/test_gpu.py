"""Tests of what a GPU needs, on the CPU and, where there is one, on a GPU: each class of
harness/gpu.py is compared with the one that it replaces."""

import itertools
from copy import deepcopy
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import run
from ensemble import EnsembleDDPG
from harness.gpu import EnsembleOnGPU, HERBufferOnGPU
from harness.testing import SMALL, main, without_timing
from run import Config
from vcp import IMPORTANCE, PRIORITIES, HERBuffer

SIZES = {"obs_dim": 5, "goal_dim": 2, "action_dim": 3, "gamma": 0.9, "num_heads": 4}


@pytest.fixture(params=["cpu", *["cuda"] * torch.cuda.is_available()])
def device(request):
    return request.param


def mini_batch(rng, rows):
    sizes = {"obs": 5, "next_obs": 5, "goal": 2, "action": 3}
    batch = {name: rng.uniform(-1, 1, (rows, n)).astype(np.float32) for name, n in sizes.items()}
    batch["reward"] = -rng.integers(2, size=rows).astype(np.float32)
    batch["weight"] = rng.random(rows).astype(np.float32)
    return {**batch, "hindsight": rng.random(rows) < 0.8}


def tensors(agent):
    """The weights, the targets, and of each weight Adam's moments and its number of steps."""
    state = agent.state_dict()
    of_adam = [x for moments in state["optimizer"]["state"].values() for x in moments.values()]
    return [x for net in state["networks"] for x in net] + of_adam


@pytest.mark.parametrize("together", [1, 2, 4])
def test_the_updates_are_those_of_the_ensemble(device, together):
    """10 steps of each head, more than are taken before the capture, and the targets between. Each
    begins with the same numbers: roundings grow, where they decide whether a unit fires."""
    plain, ours = EnsembleDDPG(**SIZES), EnsembleOnGPU(**SIZES, device=device)
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(100, 7))
    for agent in (plain, ours):
        agent.normalizer.update(seen)
    for i in range(10):
        for first in range(0, 4, together):
            batches = [mini_batch(rng, 32) for _ in range(together)]
            heads = range(first, first + together)
            expected, losses = (agent.update_heads(heads, batches) for agent in (plain, ours))
            torch.testing.assert_close(losses.cpu(), expected, rtol=1e-4, atol=1e-5)
            if i % 4 == 3:
                plain.update_targets()
                ours.update_targets()
            for expected, x in zip(tensors(plain), tensors(ours), strict=True):
                # a step of Adam is 1e-3, and one of a target at least 5e-5
                assert ((x.cpu() - expected).abs() > 1e-5).sum() <= 1 + 0.02 * x.numel()
                x.copy_(expected)
    variances = [agent.q_variance(seen[:, :5], seen[:, :3], seen[:, 5:]) for agent in (plain, ours)]
    np.testing.assert_allclose(*variances, rtol=1e-2)


def test_it_acts_with_the_actors_as_they_are(device):
    """After a step, after what the normaliser saw, and after loading."""
    agent, rng = EnsembleOnGPU(**SIZES, device=device), np.random.default_rng(0)
    rows, acted = (rng.normal(size=(4, 6, 5)), rng.normal(size=(4, 6, 2))), []

    def check():
        with torch.no_grad():
            acted.append(agent.actor.all_heads(agent._state(*rows)).cpu().numpy())
        np.testing.assert_allclose(agent.act(*rows), acted[-1], atol=1e-5)
        some = agent.act(*(x[1:3] for x in rows), slice(1, 3))
        np.testing.assert_allclose(some, acted[-1][1:3], atol=1e-5)

    def train(steps):
        for _ in range(steps):
            agent.update_heads(range(4), [mini_batch(rng, 8) for _ in range(4)])
        check()

    def see():
        agent.normalizer.update(rng.normal(1, size=(100, 7)))
        check()

    see()
    train(1)
    saved = deepcopy(agent.state_dict())
    see()
    train(5)
    agent.load_state_dict(deepcopy(saved))
    train(5)
    agent.load_state_dict(saved)
    check()
    agent.load_state_dict(EnsembleOnGPU(**SIZES, device=device, seed=1).state_dict())
    check()
    assert all(abs(x - y).max() > 1e-4 for x, y in itertools.pairwise(acted))
    assert np.isfinite(acted).all()  # also of one that has seen and learned nothing


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


def test_the_first_whose_cumulative_probability_is_above(device):
    """Of four equal ones: 0 is the first's, 1/4 the second's."""
    edges = SimpleNamespace(random=lambda shape: np.array([[0.0, 0.25, 0.75]]))
    buffer = HERBufferOnGPU(4, 1.0, "uniform", at_once=1, device=device)
    rows = np.arange(4, dtype=np.float32)
    buffer.add({"obs": rows, "hindsight": rows > 1}, rows)
    buffer.update_priorities()
    assert buffer.sample(3, edges)["obs"].tolist() == [0, 1, 3]


@pytest.mark.parametrize(
    "variance", [[0.1, np.nan], [0.1, np.inf], [0.1], [[0.1], [0.2]], [0.1, 0.2, 0.3]]
)
def test_what_b_h_refuses_is_refused(device, variance):
    """By the plain buffer too, there in `add` or in `update_priorities`."""
    error = ValueError if np.isfinite(variance).all() else FloatingPointError
    for buffer in (HERBuffer(2, 1.0), HERBufferOnGPU(2, 1.0, at_once=1, device=device)):
        rows = np.zeros(3 if len(variance) == 3 else 2, np.float32)
        with pytest.raises(error):
            buffer.add({"obs": rows, "hindsight": rows > 1}, np.float32(variance))
            buffer.update_priorities()


def test_what_was_drawn_before_is_not_handed_out_afterwards(device):
    buffer, rng = HERBufferOnGPU(4, 1.0, at_once=2, device=device), np.random.default_rng(0)
    for i in range(3):
        rows = np.full(4, i, np.float32)
        buffer.add({"obs": rows, "hindsight": rows > 1}, rows)
        with pytest.raises(ValueError, match="call update_priorities"):
            buffer.sample(3, rng)
        for _ in range(2):  # of two drawn at once one is left
            buffer.update_priorities()
            state = rng.bit_generator.state
            assert buffer.sample(3, rng)["obs"].tolist() == [i, i, i]
            assert rng.bit_generator.state != state


@pytest.mark.parametrize(("method", "together"), [("vcp", 1), ("vcp", 4), ("her", 4)])
def test_a_run_is_the_one_of_the_cpu(device, method, together, tmp_path, monkeypatch):
    """Two epochs, the second one resumed; the CPU can go on with what it leaves. With larger steps
    roundings grow, up to where another transition is drawn."""
    common = {**SMALL, "method": method, "epochs": 2, "heads": 4, "heads_at_once": together}
    common["learning_rate"] = 1e-4
    run.train(Config(**common, out=str(tmp_path / "cpu"), device="cpu"))
    if device == "cpu":
        monkeypatch.setattr("harness.assemble.EnsembleDDPG", EnsembleOnGPU)
        ours = partial(HERBufferOnGPU, at_once=4, device="cpu")
        monkeypatch.setattr("harness.assemble.HERBuffer", ours)
    common |= {"out": str(tmp_path / "gpu"), "device": device}
    run.train(Config(**{**common, "epochs": 1}))
    run.train(Config(**common), resume=True)
    rows = (without_timing(tmp_path / name) for name in ("cpu", "gpu"))
    for expected, row in zip(*rows, strict=True):
        for name, x in expected.items():
            np.testing.assert_allclose(row[name], x, rtol=0.02, atol=1e-3, err_msg=name)
    monkeypatch.undo()
    main([f"--resume={tmp_path / 'gpu'}", "--epochs=3", "--device=cpu"])
