"""How fast this is, beside what limits it: python -m experiments.bench [--quick]

Absolute times depend on the machine and on what else it does, so each figure is printed beside a
yardstick that was measured in turn with it: the matrix products of an update alone, the raw
environment, the same epoch with `--priority uniform`. Medians, with the quartiles behind them.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, redirect_stdout

import numpy as np
import torch

import run
from ensemble import HIDDEN, EnsembleDDPG
from harness.assemble import make_replay
from harness.numerics import begin_thread, fast_products, one_thread
from harness.settings import METHODS, Config, complete
from harness.tasks import examine, make_env
from harness.workers import ParallelEnvs, available_cores, number_of_workers
from her import EpisodeBuffer
from vcp import score, update_her_buffer

SIZES = {"FetchReach-v1": (10, 3, 4), "FetchPush-v1": (25, 3, 4), "HandReach-v0": (63, 15, 20)}
PAPER_MINUTES = {2: 3.2, 4: 5.6, 8: 8.5, 16: 12.0, 32: 20.7}  # Table 2, HandReach
PAPER_METHODS = {  # Tables 1 and 3, HandReach: minutes with one network, with the ensemble
    "vcp": (12.0, 12.0),
    "her": (1.5, 9.3),
    "herebp": (2.74, 11.0),
    "cher": (8.2, 60.5),
    "dtgsh": (34.1, 253.0),
}


def in_turn(functions: dict[str, Callable], repeats: int) -> dict[str, np.ndarray]:
    """Seconds of each call, (repeats,) for each function, the functions taking turns."""
    seconds = {name: [] for name in functions}
    for i in range(repeats + 1):  # the first round warms up
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            if i:
                seconds[name].append(time.perf_counter() - start)
    return {name: np.array(s) for name, s in seconds.items()}


def spread(x: np.ndarray, unit: float = 1, digits: int = 1) -> str:
    low, middle, high = (unit * np.quantile(x, q) for q in (0.25, 0.5, 0.75))
    return f"{middle:.{digits}f} ({low:.{digits}f}-{high:.{digits}f})"


def products(batch: int, state: int, action: int) -> list[tuple[int, int, int]]:
    """The matrix products (m, k)·(k, n) of one head's update, as (m, k, n)."""

    def layers(inputs, outputs):
        return [(inputs, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, outputs)]

    actor, critic = layers(state, action), layers(state + action, 1)

    def forward(net):
        return [(batch, i, j) for i, j in net]

    def to_weights(net):
        return [(i, batch, j) for i, j in net]

    def to_inputs(net):
        return [(batch, j, i) for i, j in net]

    target = forward(actor) + forward(critic)
    critic_step = forward(critic) + to_weights(critic) + to_inputs(critic[1:])
    actor_step = forward(actor) + forward(critic) + to_inputs(critic)
    actor_step += to_weights(actor) + to_inputs(actor[1:])
    return target + critic_step + actor_step


def random_batch(batch, obs_dim, goal_dim, action_dim):
    rng = np.random.default_rng(0)
    rows = {"obs": obs_dim, "next_obs": obs_dim, "goal": goal_dim, "action": action_dim}
    data = {k: rng.uniform(-1, 1, (batch, d)).astype(np.float32) for k, d in rows.items()}
    data["reward"], data["weight"] = -np.ones(batch, np.float32), np.ones(batch, np.float32)
    return data


def bench_update(repeats: int, heads: int = 16) -> None:
    print(
        "\n1. The ensemble update: 16 heads in sequence, beside its matrix products alone (floor):"
    )
    print("   as PyTorch makes them, and as a run has them made (numerics.fast_products)")
    print(
        f"{'sizes of':14} {'batch':>5} {'update ms':>20} {'floor ms':>20} {'ratio':>6}"
        f" {'fast floor ms':>20} {'ratio':>6}"
    )
    for name, (obs_dim, goal_dim, action_dim) in SIZES.items():
        for batch in (64, 256):
            agent = EnsembleDDPG(obs_dim, goal_dim, action_dim, gamma=0.98, num_heads=heads)
            data = random_batch(batch, obs_dim, goal_dim, action_dim)
            operands = [
                (torch.randn(m, k), torch.randn(k, n), torch.empty(m, n))
                for m, k, n in products(batch, obs_dim + goal_dim, action_dim)
            ]

            def update(agent=agent, data=data):
                with fast_products():
                    for k in range(heads):
                        agent.update_head(k, data)

            def floor(operands=operands):
                for _ in range(heads):
                    for a, b, out in operands:
                        torch.mm(a, b, out=out)

            def fast_floor(floor=floor):
                with fast_products():
                    floor()

            t = in_turn({"update": update, "floor": floor, "fast": fast_floor}, repeats)
            ms = {name: spread(x, 1e3) for name, x in t.items()}
            ratio = {name: np.median(t["update"]) / np.median(x) for name, x in t.items()}
            print(
                f"{name:14} {batch:5} {ms['update']:>20} {ms['floor']:>20} {ratio['floor']:6.2f}"
                f" {ms['fast']:>20} {ratio['fast']:6.2f}"
            )


def bench_collection(repeats: int, num_envs: int = 16, horizon: int = 50) -> None:
    cores = len(available_cores())
    print(f"\n2. Collection with {num_envs} environments, beside {cores} cores x raw env.step")
    print(f"{'environment':14} {'steps/s':>22} {'raw, one core':>22} {'ratio':>6}")
    for name, (obs_dim, goal_dim, action_dim) in SIZES.items():
        agent = EnsembleDDPG(obs_dim, goal_dim, action_dim, gamma=0.98)
        env, rng = make_env(name), np.random.default_rng(0)  # as gymnasium makes it
        raw_actions = rng.uniform(-1, 1, (horizon, action_dim)).astype(np.float32)

        def play(agent=agent, rng=rng, shape=(horizon, num_envs, action_dim)):
            noise = run.exploration(rng, shape, 0.2, 0.3)
            run.rollout(envs, run.acting_heads(agent, 16, num_envs, noise), horizon)

        def raw(env=env, actions=raw_actions):
            env.reset()
            for action in actions:
                env.step(action)

        workers = number_of_workers(None, num_envs)
        with ParallelEnvs(name, num_envs, workers, in_halves=workers > 1) as envs:
            envs.reset(0)
            t = in_turn({"play": play, "raw": raw}, repeats)
        rate, raw_rate = num_envs * horizon / t["play"], horizon / t["raw"]
        ratio = np.median(rate) / (cores * np.median(raw_rate))
        print(
            f"{name:14} {spread(rate, digits=0):>22} {spread(raw_rate, digits=0):>22} {ratio:6.2f}"
        )


def full_buffer(name: str, rng: np.random.Generator, transitions: int = 100_000) -> EpisodeBuffer:
    """B_o with random observations and achieved goals that walk at random."""
    obs_dim, goal_dim, action_dim = SIZES[name]
    dims = (obs_dim, goal_dim, action_dim)
    buffer = EpisodeBuffer(transitions, 50, *dims, 0.8, examine(name).reward_fn)
    n = buffer.capacity
    walk = rng.normal(0, 0.01, (n, 51, goal_dim)).cumsum(axis=1)
    episodes = {
        "obs": rng.normal(size=(n, 51, obs_dim)),
        "achieved_goal": walk + rng.uniform(-0.15, 0.15, (n, 1, goal_dim)),
        "desired_goal": rng.uniform(-0.15, 0.15, (n, goal_dim)),
        "action": rng.uniform(-1, 1, (n, 50, action_dim)),
    }
    buffer.add({k: x.astype(np.float32) for k, x in episodes.items()}, rng)
    return buffer


@contextmanager
def busy_core():
    """Another process that never rests, on one of the cores."""
    core = available_cores()[0]
    program = f"import os; os.sched_setaffinity(0, {{{core}}})\nwhile True: pass"
    process = subprocess.Popen([sys.executable, "-c", program])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def bench_algorithm_1(repeats: int, heads: int = 16) -> None:
    print(
        "\n3. A sweep of the heads, B_h full: Algorithm 1 beside it (line 13), in turn, left out;"
    )
    print("   one transition scored for each one drawn. Busy: another process on one of the cores")
    names = ["left out", "beside", "in turn"]
    heading = "".join(f"{name:>20}" for name in names)
    print(f"{'ms, sizes of':14} {heading}  beside by left out, by in turn")
    for name in ("FetchPush-v1", "HandReach-v0"):
        size, rng = 256, np.random.default_rng(0)
        agent = EnsembleDDPG(*SIZES[name], gamma=0.98, num_heads=heads)
        original = full_buffer(name, rng)
        her_buffer = make_replay(complete(Config(env=name, heads=heads)), examine(name), original)
        how = (heads * size, np.random.default_rng(1))
        while her_buffer.size < her_buffer.capacity:
            update_her_buffer(her_buffer, original, agent.q_variance, *how)

        def train(agent=agent, her_buffer=her_buffer, rng=rng):
            batches = [her_buffer.sample(256, rng) for _ in range(heads)]
            agent.update_heads(range(heads), batches, pool.map)

        def beside(agent=agent, original=original, her_buffer=her_buffer, how=how, train=train):
            scoring = thread.submit(score, original, agent.snapshot_q_variance(pool.map), *how)
            train()
            her_buffer.add(*scoring.result())
            her_buffer.update_priorities()

        def in_turn_with_it(agent=agent, buffers=(her_buffer, original), how=how, train=train):
            update_her_buffer(*buffers, agent.snapshot_q_variance(pool.map), *how)
            train()

        with (
            ThreadPoolExecutor(1, initializer=begin_thread) as thread,
            ThreadPoolExecutor(len(available_cores()), initializer=begin_thread) as pool,
            fast_products(),
        ):
            ways = dict(zip(names, (train, beside, in_turn_with_it), strict=True))
            t = in_turn(ways, repeats)
            with busy_core():
                busy = in_turn({"beside": beside}, repeats)["beside"]
        columns = "".join(f"{spread(t[n], 1e3):>20}" for n in names)
        ratios = [np.median(t["beside"]) / np.median(t[n]) for n in ("left out", "in turn")]
        slower = np.median(busy) / np.median(t["beside"])
        print(
            f"{name:14} {columns}  {ratios[0]:10.2f} {ratios[1]:10.2f}; busy {slower:.2f} of itself"
        )


def cycle_seconds(cycles: int, **settings) -> dict[str, float]:
    """Seconds a cycle and an evaluation take, from a short real run."""
    with tempfile.TemporaryDirectory() as folder, open(os.devnull, "w") as null:
        config = Config(**settings, epochs=1, cycles=cycles, eval_episodes=16, out=f"{folder}/run")
        with redirect_stdout(null):
            (row,) = run.train(config)
    # the warm-up is not in collect_seconds; evaluation here is a tenth of an epoch's
    collect, train = row["collect_seconds"] / cycles, row["train_seconds"] / cycles
    return {
        "cycle": collect + train,
        "collect": collect,
        "train": train,
        "eval": row["eval_seconds"],
    }


def bench_epochs(cycles: int, repeats: int, names: list[str]) -> None:
    print("\n4. An epoch at the paper's settings, beside the same epoch with --priority uniform")
    print("   (which scores B_h too)")
    for name in names:
        t = {"consistency": [], "uniform": []}
        for _ in range(repeats):
            for priority, rows in t.items():
                rows.append(cycle_seconds(cycles, env=name, priority=priority))
        cycle = {p: np.array([r["cycle"] for r in rows]) for p, rows in t.items()}
        ratio = np.median(cycle["consistency"]) / np.median(cycle["uniform"])
        print(
            f"{name:14} VCP {spread(cycle['consistency'], digits=2)} s a cycle, uniform"
            f" {spread(cycle['uniform'], digits=2)} s, ratio {ratio:.2f}"
        )


def bench_heads(cycles: int) -> None:
    print("\n5. Seconds a cycle and minutes an epoch by the number of heads, HandReach")
    print("   heads  s/cycle  min/epoch  paper's Table 2")
    for heads, paper in PAPER_MINUTES.items():
        t = cycle_seconds(cycles, env="HandReach-v0", heads=heads)
        minutes = (50 * t["cycle"] + 10 * t["eval"]) / 60
        print(f"   {heads:5} {t['cycle']:8.2f} {minutes:10.1f} {paper:16.1f}")


def bench_draws(repeats: int, heads: int = 16) -> None:
    print("\n6. Drawing a mini-batch by the other methods, and its share of the update it feeds")
    print(f"{'sizes of':14} {'batch':>5} {'method':8} {'draw ms':>22} {'share':>6}")
    for name in SIZES:
        rng = np.random.default_rng(0)
        original = full_buffer(name, rng)
        agent = EnsembleDDPG(*SIZES[name], gamma=0.98, num_heads=heads)
        for batch in (64, 256):
            replays, calls = {}, 40
            for method in METHODS[1:] if batch == 64 else METHODS[1:-1]:  # DTGSH: 64 alone
                config = complete(Config(env=name, method=method, batch_size=batch))
                replays[method] = make_replay(config, examine(name), original)
                replays[method].new_episodes(np.arange(original.size))
            data = random_batch(batch, *SIZES[name])
            functions = {
                method: lambda r=r, batch=batch: [r.sample(batch, rng) for _ in range(calls)]  # noqa: B023
                for method, r in replays.items()
            }
            functions["update"] = lambda data=data: [
                agent.update_head(k % heads, data)  # noqa: B023
                for k in range(calls)  # noqa: B023
            ]
            t = in_turn(functions, repeats)
            update = np.median(t.pop("update"))
            for method, x in t.items():
                print(
                    f"{name:14} {batch:5} {method:8} {spread(x / calls, 1e3, 2):>22}"
                    f" {np.median(x) / update:6.1%}"
                )


def bench_methods(cycles: int) -> None:
    print("\n7. Minutes an epoch of every method, HandReach, and the ratio to VCP")
    print("              one network   paper's Table 1        16 heads   paper's Table 3")
    seconds = {
        (method, heads): cycle_seconds(cycles, env="HandReach-v0", method=method, heads=heads)
        for heads in (1, 16)
        for method in METHODS
        if (method, heads) != ("vcp", 1)
    }
    minutes = {k: (50 * t["cycle"] + 10 * t["eval"]) / 60 for k, t in seconds.items()}
    vcp = minutes["vcp", 16]
    for method, paper in PAPER_METHODS.items():
        ours = (minutes.get((method, 1), vcp), minutes[method, 16])
        columns = (
            f"{x:8.2f} ({x / vcp:5.2f}) {p:8.2f} ({p / 12:5.2f})"
            for x, p in zip(ours, paper, strict=True)
        )
        print(f"{method:8}", *columns)


@one_thread()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="1 to 4 and 6, with fewer repeats")
    quick = parser.parse_args().quick
    print(f"PyTorch {torch.__version__}, {torch.get_num_threads()} threads")
    bench_update(2 if quick else 20)
    with fast_products():
        bench_collection(2 if quick else 10)
        bench_algorithm_1(1 if quick else 15)
    if quick:
        bench_epochs(1, 1, ["FetchPush-v1"])
    else:
        bench_epochs(2, 2, ["FetchPush-v1", "HandReach-v0"])
        bench_heads(2)
    with fast_products():
        bench_draws(1 if quick else 10)
    if not quick:
        bench_methods(2)


if __name__ == "__main__":
    main()
