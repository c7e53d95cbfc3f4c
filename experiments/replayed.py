"""What each method would replay of the same episodes: python -m experiments.replayed DIR...

From the last checkpoint of each run, its B_o and, for VCP, its critics: the share of the hindsight
transitions that a method draws whose action does not reach the goal, r = -1. The others are at
their goal, in a task with an object mostly because nothing has touched it.
"""

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import options
import run
from envs_point import UsageError
from experiments.checkpoints import restored
from experiments.figures import label
from options import METHODS, Config
from vcp import update_her_buffer

BATCHES = 160  # mini-batches that are looked at
SCORED = 4096  # transitions at once, by Algorithm 1


def share_ahead(its: SimpleNamespace, method: str, rng: np.random.Generator) -> float:
    """The share of r = -1 among the hindsight transitions that `method` draws from B_o, with the
    batch and the B_h of Appendix B's larger tasks. its: what `restored` gives. NaN for VCP with the
    critic of one network."""
    heads, ratio = its.config.heads, its.config.relabel_ratio
    if method == "vcp" and heads == 1:
        return math.nan
    schedule = options.paper_schedule("FetchPush-v1", method)
    config = options.complete(
        Config(its.config.env, method, heads=heads, relabel_ratio=ratio, **schedule)
    )
    replay = run.make_replay(config, its.env, its.original, its.reward_fn)
    if method == "vcp":
        for _ in range(replay.capacity // SCORED):
            update_her_buffer(
                its.original, replay, its.agent.q_variance, SCORED, rng, ratio, its.reward_fn
            )
    else:
        replay.new_episodes(np.arange(its.original.size))
    drawn = [replay.sample(config.batch_size, rng) for _ in range(BATCHES)]
    reward = np.concatenate([batch["reward"][batch["hindsight"]] for batch in drawn])
    return float((reward < 0).mean())


def main(folders: list[str]) -> None:
    if not folders:
        sys.exit("usage: python -m experiments.replayed DIR...")
    print(f"| run | epoch | {' | '.join(map(str.upper, METHODS))} |")
    print(f"|---|---|{'---|' * len(METHODS)}")
    for folder in folders:
        its = restored(Path(folder))
        rng = np.random.default_rng(0)
        shares = [f"{share_ahead(its, method, rng):.1%}" for method in METHODS]
        print(f"| {its.config.env}, {label(its.config)} | {its.epoch} | {' | '.join(shares)} |")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UsageError as error:
        sys.exit(f"replayed.py: {error}")
