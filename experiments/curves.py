"""Test success by epoch of every run in results/: python -m experiments.curves

Draws results/curves.png: a panel for each environment, a thin line for each seed, and their mean.
"""

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from records import read_rows

RESULTS = Path(__file__).parent.parent / "results"


def draw(results: Path) -> Path:
    """Read results/<env>/<method>/seed<s>/progress.csv, write results/curves.png, give its path."""
    runs = defaultdict(list)  # (env, method) -> success rates by epoch, one list for each seed
    for file in sorted(results.glob("*/*/seed*/progress.csv")):
        env, method = file.parts[-4:-2]
        runs[env, method].append([row["test_success_rate"] for row in read_rows(file.parent)])
    envs = sorted({env for env, _ in runs})
    if not envs:
        sys.exit(f"no runs in {results}")
    fig = Figure(figsize=(3 * len(envs), 3), layout="constrained")
    panels = fig.subplots(1, len(envs), sharey=True, squeeze=False)[0]
    for ax, env in zip(panels, envs, strict=True):
        methods = [method for e, method in runs if e == env]
        for i, method in enumerate(methods):
            seeds = runs[env, method]
            for rates in seeds:
                ax.plot(range(1, len(rates) + 1), rates, color=f"C{i}", alpha=0.3, linewidth=1)
            shortest = min(map(len, seeds))
            mean = np.mean([rates[:shortest] for rates in seeds], axis=0)
            label = f"{method.upper()}, mean of {len(seeds)}"
            ax.plot(range(1, shortest + 1), mean, color=f"C{i}", linewidth=2, label=label)
        ax.set(title=env, xlabel="epoch", ylim=(-0.03, 1.03))
        ax.xaxis.get_major_locator().set_params(integer=True)
        ax.grid(alpha=0.3)
        ax.legend(loc="lower right", fontsize=8)
    panels[0].set_ylabel("test success rate")
    fig.savefig(results / "curves.png", dpi=90)
    return results / "curves.png"


if __name__ == "__main__":
    print(draw(RESULTS))
