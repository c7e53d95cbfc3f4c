"""How fast this is, beside what limits it: python -m experiments.bench [--quick]

Absolute times depend on the machine and on what else it does, so each figure is printed beside a
yardstick that was measured in turn with it: the matrix products of an update alone, the raw
environment, the same sweep without scoring, one core. Parts 1 and 2 print medians with the
quartiles behind them.
"""

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout

import numpy as np
import torch

import run
from ensemble import HIDDEN, EnsembleDDPG
from harness.assemble import make_replay, number_of_envs
from harness.numerics import begin_thread, for_training
from harness.settings import Config, complete, variant
from harness.tasks import examine, make_env
from harness.workers import ParallelEnvs, available_cores, number_of_workers
from her import EpisodeBuffer
from vcp import score, update_her_buffer

HEADS = 16
SIZES = {"FetchReach-v1": (10, 3, 4), "FetchPush-v1": (25, 3, 4), "HandReach-v0": (63, 15, 20)}
# The paper's minutes of an epoch of HandReach: VCP by the number of heads (Table 2), the other
# methods with one network and with 16 heads (Tables 1 and 3)
OF_HEADS = {16: 12.0, 2: 3.2, 4: 5.6, 8: 8.5, 32: 20.7}
OF_OTHERS = {"her": (1.5, 9.3), "herebp": (2.74, 11.0), "cher": (8.2, 60.5), "dtgsh": (34.1, 253.0)}


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

    def network(inputs, outputs, forward):
        layers = [(inputs, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, outputs)]
        to_weights = [(i, batch, j) for i, j in layers]
        to_inputs = [(batch, j, i) for i, j in layers]
        return forward * [(batch, i, j) for i, j in layers] + to_weights + to_inputs[1:], to_inputs

    actor, _ = network(state, action, 2)  # for the target and for its own loss
    critic, to_its_action = network(state + action, 1, 3)  # and for the actor's
    return actor + critic + to_its_action


def filled(name: str, batch: int, transitions: int = 100_000) -> tuple:
    """An agent, a B_o of random episodes, and a B_h that was filled from it."""
    rng, (obs_dim, goal_dim, action_dim) = np.random.default_rng(0), SIZES[name]
    task, agent = examine(name), EnsembleDDPG(*SIZES[name], gamma=0.98)
    original = EpisodeBuffer(transitions, 50, *SIZES[name], 0.8, task.compute_reward)
    n = original.max_episodes
    shapes = {"obs": (n, 51, obs_dim), "achieved_goal": (n, 51, goal_dim)}
    shapes |= {"desired_goal": (n, goal_dim), "action": (n, 50, action_dim)}
    original.add({k: rng.uniform(-1, 1, s).astype(np.float32) for k, s in shapes.items()}, rng)
    her_buffer = make_replay(complete(Config(env=name, batch_size=batch)), task, original)
    while her_buffer.size < her_buffer.capacity:
        update_her_buffer(her_buffer, original, agent.q_variance, batch * HEADS, rng)
    return agent, original, her_buffer


def bench_update(repeats: int) -> None:
    print("\n1. The ensemble update: 16 heads in turn, beside its matrix products alone (floor)")
    print(f"{'sizes of':14} {'batch':>5} {'update ms':>20} {'floor ms':>20} {'ratio':>6}")
    for name, (obs_dim, goal_dim, action_dim) in SIZES.items():
        for batch in (64, 256):
            agent, _, her_buffer = filled(name, batch)
            data = her_buffer.sample(batch, np.random.default_rng(0))
            operands = [
                (torch.randn(m, k), torch.randn(k, n), torch.empty(m, n))
                for m, k, n in products(batch, obs_dim + goal_dim, action_dim)
            ]

            def update(agent=agent, data=data):
                for k in range(HEADS):
                    agent.update_head(k, data)

            def floor(operands=operands):
                for _ in range(HEADS):
                    for a, b, out in operands:
                        torch.mm(a, b, out=out)

            t = in_turn({"update": update, "floor": floor}, repeats)
            ratio = np.median(t["update"]) / np.median(t["floor"])
            ms = [spread(x, 1e3) for x in t.values()]
            print(f"{name:14} {batch:5} {ms[0]:>20} {ms[1]:>20} {ratio:6.2f}")


def bench_collection(repeats: int, horizon: int = 50) -> None:
    cores = len(available_cores())
    print(f"\n2. Collection with {HEADS} environments, beside {cores} cores x raw env.step")
    print(f"{'environment':14} {'steps/s':>22} {'raw, one core':>22} {'ratio':>6}")
    for name, (obs_dim, goal_dim, action_dim) in SIZES.items():
        agent = EnsembleDDPG(obs_dim, goal_dim, action_dim, gamma=0.98)
        env, rng = make_env(name), np.random.default_rng(0)  # as gymnasium makes it
        raw_actions = rng.uniform(-1, 1, (horizon, action_dim)).astype(np.float32)

        def play(agent=agent, rng=rng, shape=(horizon, HEADS, action_dim)):
            noise = run.exploration(rng, shape, 0.2, 0.3)
            run.rollout(envs, run.acting_heads(agent, HEADS, HEADS, noise), horizon)

        def raw(env=env, actions=raw_actions):
            env.reset()
            for action in actions:
                env.step(action)

        workers = number_of_workers(None, HEADS)
        with ParallelEnvs(name, HEADS, workers, in_halves=workers > 1) as envs:
            envs.reset(0)
            t = in_turn({"play": play, "raw": raw}, repeats)
        rate, raw_rate = HEADS * horizon / t["play"], horizon / t["raw"]
        ratio = np.median(rate) / (cores * np.median(raw_rate))
        steps = [spread(x, digits=0) for x in (rate, raw_rate)]
        print(f"{name:14} {steps[0]:>22} {steps[1]:>22} {ratio:6.2f}")


def sweep_seconds(agent, original, her_buffer, repeats: int) -> list[np.ndarray]:
    """Seconds of a sweep of the heads that step together, with a thread for each core: alone, with
    one transition scored beside it for each one drawn, and that beside a busy process."""
    rng, how = np.random.default_rng(0), (256 * HEADS, np.random.default_rng(1))

    def train():
        batches = [her_buffer.sample(256, rng) for _ in range(HEADS)]
        agent.update_heads(range(HEADS), batches, pool.map)

    def beside():
        scored = thread.submit(score, original, agent.snapshot_q_variance(pool.map), *how)
        train()
        her_buffer.add(*scored.result())
        her_buffer.update_priorities()

    with (
        ThreadPoolExecutor(1, initializer=begin_thread) as thread,
        ThreadPoolExecutor(len(available_cores()), initializer=begin_thread) as pool,
    ):
        t = in_turn({"alone": train, "beside": beside}, repeats)
        core = available_cores()[0]
        program = f"import os; os.sched_setaffinity(0, {{{core}}})\nwhile True: pass"
        with subprocess.Popen([sys.executable, "-c", program]) as process:
            try:
                busy = in_turn({"busy": beside}, repeats)
            finally:
                process.kill()
    return [t["alone"], t["beside"], busy["busy"]]


def run_seconds(cycles: int, **given) -> tuple[float, float]:
    """Seconds of a cycle and of an epoch, 50 cycles and a test, from a short real run."""
    with tempfile.TemporaryDirectory() as folder, open(os.devnull, "w") as null:
        config = Config(**given, epochs=1, cycles=cycles, eval_episodes=16, out=f"{folder}/run")
        with redirect_stdout(null):
            (row,) = run.train(config)
    # the warm-up is in collect_seconds too; the test here is one round, as many episodes as there
    # are environments, of an epoch's 160
    cycle = row["collect_seconds"] / (cycles + 1) + row["train_seconds"] / cycles
    rounds = math.ceil(160 / number_of_envs(config))
    return cycle, 50 * cycle + rounds * row["eval_seconds"]


def bench_cores(repeats: int, cycles: int) -> None:
    """A sweep, a cycle and an epoch by the number of cores."""
    if not hasattr(os, "sched_setaffinity"):
        print("\n3. By the number of cores: on Linux alone")
        return
    print(
        "\n3. By the number of cores: ms of a sweep, alone, with scoring beside it (line 13), that"
    )
    print("   with a busy process on one of them; seconds of a cycle, minutes of an epoch")
    columns = ("alone", "scoring", "busy", "ideal", "cycle s", "ideal", "epoch min")
    cores = available_cores()
    for name in ("FetchPush-v1", "HandReach-v0"):
        print(f"{name} cores" + "".join(f" |{column:>9}" for column in columns))
        parts = filled(name, 256)
        for n in [n for n in (1, 2, 4, 8, 16) if n <= len(cores)]:
            os.sched_setaffinity(0, cores[:n])  # what is started now keeps to them too
            sweep = [1e3 * np.median(t) for t in sweep_seconds(*parts, repeats)]
            cycle, epoch = run_seconds(cycles, env=name, device="cpu")
            if n == 1:
                first = sweep[1], cycle
            values = (*sweep, first[0] / n, cycle, first[1] / n, epoch / 60)
            print(f"{name} {n:5}" + "".join(f" |{value:9.2f}" for value in values))
        os.sched_setaffinity(0, cores)
        if torch.cuda.is_available():
            cycle, epoch = run_seconds(cycles, env=name, device="cuda")
            print(f"{name}  a GPU: {cycle:.2f} s a cycle, {epoch / 60:.2f} min an epoch")


def bench_paper(cycles: int) -> None:
    print("\n4. Tables 1 to 3, HandReach: minutes of an epoch, and the ratio to VCP with 16 heads")
    rows, vcp = [("vcp", heads, minutes) for heads, minutes in OF_HEADS.items()], 0.0
    for method, both in OF_OTHERS.items():
        rows += [(method, heads, minutes) for heads, minutes in zip((1, 16), both, strict=True)]
    for method, heads, paper in rows:
        given = {"env": "HandReach-v0", "method": method, "heads": heads}
        minutes = run_seconds(cycles, **given)[1] / 60
        vcp = vcp or minutes
        print(
            f"{variant(complete(Config(**given))):16} {minutes:6.2f} ({minutes / vcp:5.2f})"
            f"   paper {paper:6.2f} ({paper / 12:5.2f})"
        )


@for_training()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="1 to 3, with fewer repeats")
    quick = parser.parse_args().quick
    print(f"PyTorch {torch.__version__}, cores: {len(available_cores())}")
    bench_update(2 if quick else 20)
    bench_collection(2 if quick else 10)
    bench_cores(1 if quick else 15, 1 if quick else 3)
    if not quick:
        bench_paper(2)


if __name__ == "__main__":
    main()
