"""Look into the checkpoints of runs: python -m experiments.inspect_run WHAT DIR...

WHAT is one of
    effective    how much Eq. (4) prefers, at the paper's temperatures: the effective sample size of
                 B_h, 1 / Σ p², as a share of its transitions (100 % is uniform); the same of the
                 hindsight alone; the share of originals among the draws
    replayed     what each method would draw from the run's B_o: the share of originals, and of
                 transitions whose goal is still ahead (r = -1). In a task with an object most
                 others are at their goal because nothing has touched the object
    dead         the share of the networks' hidden units that are 0 for all of 4,096 transitions,
                 and learn no more
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from ensemble import MultiHeadMLP, linear
from harness import settings
from harness.assemble import Parts, make_replay, restored
from harness.errors import UsageError
from harness.settings import METHODS, Config
from vcp import update_her_buffer, value_consistency_priority

EFFECTIVE = "size; that of hindsight alone; originals drawn"
TEMPERATURES = (1, 5, 9, 11, 15)  # Appendix B
BATCHES = 160  # mini-batches that `replayed` looks at
SCORED = 4096  # transitions at once, by Algorithm 1


def effective_share(p: np.ndarray) -> float:
    """1 / (N Σ p²) for the probabilities (N,) in B_h, or of a part of it, scaled to a sum of 1:
    between 1/N, one is always drawn, and 1. NaN of nothing."""
    return float(np.square(p.sum()) / (len(p) * np.square(p).sum())) if len(p) else np.nan


def effective(parts: Parts) -> list[str]:
    """A cell for each of the TEMPERATURES. UsageError for a run without B_h."""
    if parts.her_buffer is None:
        raise UsageError(f"a run of --method {parts.config.method} has no B_h")
    data = {name: x[: parts.her_buffer.size] for name, x in parts.her_buffer.data.items()}
    priorities = [value_consistency_priority(data["variance"], t) for t in TEMPERATURES]
    h = data["hindsight"]
    shares = [(effective_share(p), effective_share(p[h]), p[~h].sum()) for p in priorities]
    return ["; ".join(f"{share:.1%}" for share in cell) for cell in shares]


def shares(parts: Parts, method: str, rng: np.random.Generator) -> dict[str, float]:
    """Of what `method` draws from the run's B_o, with the batch and the B_h of Appendix B's larger
    tasks, the share of originals and of transitions on their way."""
    schedule = settings.paper_schedule("FetchPush-v1", method)
    config = settings.complete(
        Config(env=parts.config.env, method=method, heads=parts.config.heads, **schedule)
    )
    replay = make_replay(config, parts.task, parts.original_buffer)
    if method == "vcp":
        for _ in range(replay.capacity // SCORED):
            update_her_buffer(replay, parts.original_buffer, parts.agent.q_variance, SCORED, rng)
    else:
        replay.new_episodes(np.arange(parts.original_buffer.size))
    batches = [replay.sample(config.batch_size, rng) for _ in range(BATCHES)]
    originals = np.mean([~batch["hindsight"] for batch in batches])
    return {"originals": originals, "ahead": np.mean([batch["reward"] < 0 for batch in batches])}


def replayed(parts: Parts) -> list[str]:
    """A cell for each of METHODS; VCP with the critic of one network has none."""
    rng, cells = np.random.default_rng(0), []
    for method in METHODS:
        if method == "vcp" and parts.config.heads == 1:
            cells.append("")
        else:
            cells.append("; ".join(f"{share:.1%}" for share in shares(parts, method, rng).values()))
    return cells


@torch.no_grad()
def hidden(net: MultiHeadMLP, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the trunk ends, (1, B, H), and the heads' hidden layers, (K, B, H), for x (B, I)."""
    w1, b1, w2, b2 = net.trunk
    embedding = linear(linear(x, w1, b1).relu(), w2, b2).relu()
    return embedding[None], linear(embedding, *net.stacks[:2]).relu()


def dead_share(units: torch.Tensor) -> float:
    """The share of units that are 0 for all of the B inputs: (K, B, H) -> a number."""
    return (units.amax(dim=1) == 0).float().mean().item()


def dead(parts: Parts) -> list[str]:
    """A cell for each of actor's trunk, actors' heads, critic's trunk, critics' heads."""
    episodes, rng = parts.original_buffer.episodes, np.random.default_rng(0)
    e, t = (rng.integers(n, size=4096) for n in episodes["action"].shape[:2])
    rows = np.hstack([episodes["obs"][e, t], episodes["desired_goal"][e]])
    state = parts.agent.normalizer(torch.from_numpy(rows))
    state_action = torch.cat([state, torch.from_numpy(episodes["action"][e, t])], 1)
    layers = hidden(parts.agent.actor, state) + hidden(parts.agent.critic, state_action)
    return [f"{dead_share(units):.0%}" for units in layers]


TABLES = {
    "effective": (effective, [f"𝒯 = {t}: {EFFECTIVE}" for t in TEMPERATURES]),
    "replayed": (replayed, [f"{method.upper()}: originals; ahead" for method in METHODS]),
    "dead": (dead, ["actor's trunk", "actors' heads", "critic's trunk", "critics' heads"]),
}


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="inspect_run.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=TABLES)
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR")
    given = parser.parse_args(argv)
    cells, columns = TABLES[given.what]
    try:
        print(f"| run | epoch | {' | '.join(columns)} |")
        print("|---" * (2 + len(columns)) + "|")
        for folder in given.folders:
            parts, rows = restored(folder)
            name = f"{parts.config.env}, {settings.variant(parts.config)}"
            print(f"| {name} | {rows[-1]['epoch']} | {' | '.join(cells(parts))} |")
    except UsageError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
