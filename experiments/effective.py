"""How much Eq. (4) prefers: python -m experiments.effective DIR...

For the last checkpoint of each run, the effective sample size of B_h, 1 / Σ p², as a share of its
transitions, at the paper's temperatures. 100 % is uniform; the rest is what is hardly ever drawn.
"""

import sys
from pathlib import Path

import numpy as np

from envs_point import UsageError
from experiments.checkpoints import restored
from vcp import value_consistency_priority

TEMPERATURES = (1, 5, 9, 11, 15)  # Appendix B


def effective_share(p: np.ndarray) -> float:
    """1 / (N Σ p²) for the probabilities (N,) in B_h: between 1/N, one is always drawn, and 1."""
    return float(1 / (len(p) * np.square(p).sum()))


def main(folders: list[str]) -> None:
    if not folders:
        sys.exit("usage: python -m experiments.effective DIR...")
    print(f"| run | epoch | {' | '.join(f'𝒯 = {t}' for t in TEMPERATURES)} |")
    print(f"|---|---|{'---|' * len(TEMPERATURES)}")
    for folder in map(Path, folders):
        its = restored(folder)
        if its.config.method != "vcp":
            raise UsageError(f"{folder} holds no run of VCP")
        variance = its.replay.data["variance"][: its.replay.size]
        priorities = [value_consistency_priority(variance, t) for t in TEMPERATURES]
        shares = [f"{effective_share(p):.1%}" for p in priorities]
        name = f"{its.config.env}, {its.config.priority} priority"
        print(f"| {name} | {its.epoch} | {' | '.join(shares)} |")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UsageError as error:
        sys.exit(f"effective.py: {error}")
