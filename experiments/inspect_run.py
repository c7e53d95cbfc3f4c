"""Look into the checkpoints of runs: python -m experiments.inspect_run WHAT DIR...

WHAT is one of
    effective    how much Eq. (4) prefers, at the paper's temperatures: the effective sample size of
                 B_h, 1 / Σ p², as a share of its transitions (100 % is uniform); the same of the
                 hindsight alone; the share of originals among the draws
    goals        whether the critics disagree on hindsight whose goal is like those that are tested:
                 by the variance of the hindsight in B_h, the share whose goal is nearer to one of
                 2,000 goals of episodes than to any of 2,000 goals of other hindsight
    dead         the share of the networks' hidden units that are 0 for all of 4,096 transitions,
                 and learn no more
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from ensemble import MultiHeadMLP, linear
from harness import settings
from harness.assemble import Parts, restored
from harness.errors import UsageError
from vcp import value_consistency_priority

EFFECTIVE = "size; that of hindsight alone; originals drawn"
TEMPERATURES = (1, 5, 9, 11, 15)  # Appendix B
QUANTILES = ((0, 0.5), (0.5, 0.9), (0.9, 0.99), (0.99, 1))  # of the hindsight's variance
AMONG = 2000  # goals of each kind that `goals` looks at


def effective_share(p: np.ndarray) -> float:
    """1 / (N Σ p²) for the probabilities (N,) in B_h, or of a part of it, scaled to a sum of 1:
    between 1/N, one is always drawn, and 1. NaN of nothing."""
    return float(np.square(p.sum()) / (len(p) * np.square(p).sum())) if len(p) else np.nan


def stored(parts: Parts) -> dict[str, np.ndarray]:
    """The rows of B_h. UsageError for a run that has none."""
    if parts.her_buffer is None:
        raise UsageError(f"a run of --method {parts.config.method} has no B_h")
    return {name: x[: parts.her_buffer.size] for name, x in parts.her_buffer.data.items()}


def effective(parts: Parts) -> list[str]:
    """A cell for each of the TEMPERATURES. UsageError as `stored`."""
    data = stored(parts)
    priorities = [value_consistency_priority(data["variance"], t) for t in TEMPERATURES]
    h = data["hindsight"]
    shares = [(effective_share(p), effective_share(p[h]), p[~h].sum()) for p in priorities]
    return ["; ".join(f"{share:.1%}" for share in cell) for cell in shares]


def goals(parts: Parts) -> list[str]:
    """A cell for each of the QUANTILES. UsageError as `stored`."""
    data, rng = stored(parts), np.random.default_rng(0)
    hindsight = np.flatnonzero(data["hindsight"])
    order = hindsight[np.argsort(data["variance"][hindsight])]
    achieved, tested = data["goal"], parts.original_buffer.episodes["desired_goal"]
    among = np.concatenate([achieved[rng.choice(order, AMONG)], rng.choice(tested, AMONG)])
    scale, cells = achieved[order].std(axis=0), []
    scale[scale == 0] = 1  # a number that is the same in all
    for low, high in QUANTILES:
        i = rng.permutation(order[round(low * len(order)) : round(high * len(order))])[:AMONG]
        apart = np.stack([np.square((among - x) / scale).sum(axis=1) for x in achieved[i]])
        apart[apart < 1e-9] = np.inf  # itself
        cells.append(f"{np.mean(apart.argmin(axis=1) >= AMONG):.1%}")
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
    "goals": (goals, [f"variance, {low:.0%} to {high:.0%}" for low, high in QUANTILES]),
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
