"""Tests of how PyTorch is told to compute."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from harness.numerics import begin_thread, denormals_are_zero, for_training, small_calls
from harness.testing import HERE, SMALL_TRAINING


@pytest.mark.parametrize("call", ["mm", "bmm", "addmm", "baddbmm"])
def test_fast_products_are_float32_or_left_alone(call, monkeypatch):
    torch.manual_seed(0)
    setting, x, w = torch.backends.mkldnn.matmul, torch.randn(256, 300), torch.randn(300, 256)
    before, threads = setting.fp32_precision, torch.get_num_threads()
    torch.set_num_threads(2)
    with pytest.raises(KeyError), for_training():
        assert torch.get_num_threads() == 1 and denormals_are_zero()
        assert (x @ w - x.double() @ w.double()).abs().max() < 1e-4
        inside = setting.fp32_precision
        with small_calls():
            assert setting.fp32_precision == "ieee"
        assert setting.fp32_precision == inside
        raise KeyError
    assert torch.get_num_threads() == 2 and not denormals_are_zero()
    torch.set_num_threads(threads)
    assert setting.fp32_precision == before

    exact = getattr(torch, call)

    def rounded(*tensors):
        return exact(*(t.bfloat16().float() for t in tensors))

    monkeypatch.setattr(torch, call, rounded)  # a processor that rounds
    with for_training():
        assert setting.fp32_precision == before


def test_a_thread_begins_with_the_settings_of_training():
    def settings():
        zeros = torch.full((1,), 1e-20).square() == 0
        return torch.get_num_threads(), zeros.item()

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    with ThreadPoolExecutor(1, initializer=begin_thread) as pool:
        assert pool.submit(settings).result() == (1, True)
    torch.set_num_threads(before)


def test_training_takes_denormals_for_zero_in_all_threads(tmp_path):
    """In a process of its own: PyTorch's threads have the setting from when they are started. The
    fast products are there too."""
    program = f"""
import torch, run
from harness import numerics
from ensemble import EnsembleDDPG
def zeros():
    return (torch.full((1_000_000,), 1e-20).square() == 0).float().mean().item()
torch.set_num_threads(2)
numerics.products_are_rounded = lambda: False
def zeros_in_threads(agent):
    print("threads", torch.get_num_threads())
    print("products", torch.backends.mkldnn.matmul.fp32_precision)
    torch.set_num_threads(2)
    print("zeros", zeros())
    torch.set_num_threads(1)
EnsembleDDPG.update_targets = zeros_in_threads
run.train(run.Config(env="PointMassEmptyEnv-v1", out={str(tmp_path / "run")!r}, **{SMALL_TRAINING}))
torch.set_num_threads(1)
print("afterwards", zeros())
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        cwd=HERE,
    )
    lines = done.stdout.splitlines()
    for line in ("zeros 1.0", "threads 1", "products bf16"):
        assert lines.count(line) == SMALL_TRAINING["cycles"], done
    assert lines[-1] == "afterwards 0.0"
