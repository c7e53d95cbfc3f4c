"""How PyTorch computes here: on one thread, with the fastest exact products, without denormals."""

from contextlib import contextmanager

import torch

matmul = torch.backends.mkldnn.matmul


def begin_thread() -> None:
    """What a thread of the program's own begins with: the settings of `for_training` that PyTorch
    keeps for each thread."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)


@contextmanager
def for_training():
    """Run the block's PyTorch calls, those of `run.train` and of playing,

    - on one thread each. Products of this size gain little from more, and where a core is busy with
      something else, threads that meet after each product wait for it every time: such a run has
      been a hundred times slower.
    - with numbers below 1.2e-38 taken for 0. Adam's moments of a unit that has stopped firing decay
      to such "denormal" numbers and stay there, and an Intel processor takes 35 times as long for
      each. A thread has this from the one that starts it, so enter before PyTorch starts its own.
    - with oneDNN's products, where PyTorch by itself takes MKL's, which leave half the width of an
      AMD processor's vectors unused. PyTorch asks oneDNN if rounding to bfloat16 is allowed; only
      processors with a unit for that (AMX) then do round, and for them MKL stays.
    """
    threads, denormals = torch.get_num_threads(), denormals_are_zero()
    precision = matmul.fp32_precision
    begin_thread()
    matmul.fp32_precision = "bf16"
    if products_are_rounded():
        matmul.fp32_precision = precision
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.set_flush_denormal(denormals)
        matmul.fp32_precision = precision


@contextmanager
def small_calls():
    """Run the block with MKL's products: acting is too little work for oneDNN's."""
    precision = matmul.fp32_precision
    matmul.fp32_precision = "ieee"
    try:
        yield
    finally:
        matmul.fp32_precision = precision


def denormals_are_zero() -> bool:
    """Whether this thread takes numbers below 1.2e-38 for 0."""
    return torch.full((1,), 1e-20).square().item() == 0


def products_are_rounded() -> bool:
    """Whether a product of float32 matrices, in any of the four calls that training makes, loses
    digits that float32 has and bfloat16 has not."""
    x, one, zero = torch.full((2, 256, 256), 1 + 2**-12), torch.eye(256), torch.zeros(256)
    ones = one.expand(2, -1, -1)
    single = torch.mm(x[0], one), torch.addmm(zero, x[0], one)
    stacked = torch.bmm(x, ones), torch.baddbmm(zero, x, ones)
    return not all(torch.equal(product, x) for product in (torch.stack(single), *stacked))
