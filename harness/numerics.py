"""How PyTorch computes here: on one thread, with the fastest exact products, without denormals."""

from contextlib import ExitStack, contextmanager

import torch


@contextmanager
def for_training():
    """All of the below, for `run.train`."""
    with ExitStack() as stack:
        for setting in (one_thread, without_denormals, fast_products):
            stack.enter_context(setting())
        yield


@contextmanager
def one_thread():
    """Run the block's PyTorch calls on one thread each. Products of this size gain little from
    more, and where a core is busy with something else, threads that meet after each product wait
    for it every time: such a run has been a hundred times slower."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def begin_thread() -> None:
    """What a thread of the program's own begins with: the settings of `for_training` that PyTorch
    keeps for each thread."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)


def products_are_rounded() -> bool:
    """Whether a product of float32 matrices, in any of the four calls that training makes, loses
    digits that float32 has and bfloat16 has not."""
    x, one, zero = torch.full((2, 256, 256), 1 + 2**-12), torch.eye(256), torch.zeros(256)
    ones = one.expand(2, -1, -1)
    products = torch.stack(
        [
            torch.mm(x[0], one),
            torch.addmm(zero, x[0], one),
            torch.bmm(x, ones)[1],
            torch.baddbmm(zero, x, ones)[1],
        ]
    )
    return not torch.equal(products, x[:1].expand_as(products))


@contextmanager
def fast_products():
    """Multiply matrices with oneDNN in the block, where PyTorch by itself takes MKL, which leaves
    half the width of an AMD processor's vectors unused. PyTorch asks oneDNN if rounding to bfloat16
    is allowed; only processors with a unit for that (AMX) then do round, and for them MKL stays."""
    products = torch.backends.mkldnn.matmul
    before = products.fp32_precision
    products.fp32_precision = "bf16"
    if products_are_rounded():
        products.fp32_precision = before
    try:
        yield
    finally:
        products.fp32_precision = before


@contextmanager
def small_calls():
    """Run the block without `fast_products`: acting is too little work for it."""
    products = torch.backends.mkldnn.matmul
    precision = products.fp32_precision
    products.fp32_precision = "ieee"
    try:
        yield
    finally:
        products.fp32_precision = precision


def denormals_are_zero() -> bool:
    """Whether this thread takes numbers below 1.2e-38 for 0."""
    return torch.full((1,), 1e-20).square().item() == 0


@contextmanager
def without_denormals():
    """Take numbers below 1.2e-38 for 0 in the block. Adam's moments of a unit that has stopped
    firing decay to such "denormal" numbers and stay there, and an Intel processor takes 35 times as
    long for each. A thread has this from the one that starts it, so enter before PyTorch has
    started its own."""
    before = denormals_are_zero()
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)
