"""The folder of a run: config.json (what was asked), progress.csv (a row an epoch), curve.png."""

import csv
import json
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from envs_point import UsageError

COLUMNS = [
    "epoch",
    "env_steps",
    "wall_seconds",
    "test_success_rate",
    "train_success_rate",
    "test_q",
    "critic_loss",
    "actor_loss",
    "variance_hindsight",
    "variance_original",
    "batch_original_fraction",
    "her_buffer_size",
    "collect_seconds",
    "train_seconds",
    "eval_seconds",
]
TIMING_COLUMNS = {name for name in COLUMNS if name.endswith("_seconds")}
PACKAGES = ("numpy", "torch", "gymnasium", "gymnasium-robotics", "mujoco")


def start(folder: Path, config: dict) -> None:
    """Make the run's folder: config.json and the head of progress.csv.
    UsageError if the folder holds a run already."""
    if (folder / "progress.csv").exists():
        raise UsageError(f"{folder} already holds a run: delete it or choose another --out")
    folder.mkdir(parents=True, exist_ok=True)
    about = {
        "config": config,
        "versions": {"python": platform.python_version()} | {p: version(p) for p in PACKAGES},
        "commit": _commit(),
    }
    (folder / "config.json").write_text(json.dumps(about, indent=2) + "\n")
    with open(folder / "progress.csv", "w", newline="") as file:
        csv.writer(file).writerow(COLUMNS)


def add_row(folder: Path, row: dict) -> None:
    """Append one epoch to progress.csv and redraw curve.png."""
    with open(folder / "progress.csv", "a", newline="") as file:
        csv.DictWriter(file, COLUMNS).writerow(row)
    draw_curve(folder)


def read_rows(folder: Path) -> list[dict[str, float]]:
    """progress.csv, one dict an epoch."""
    with open(folder / "progress.csv", newline="") as file:
        return [{name: float(x) for name, x in row.items()} for row in csv.DictReader(file)]


def draw_curve(folder: Path) -> None:
    """Success rate by epoch, as curve.png."""
    rows = read_rows(folder)
    title = json.loads((folder / "config.json").read_text())["config"]
    epochs = [row["epoch"] for row in rows]
    fig, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for column, label, style in (
        ("test_success_rate", "test, no noise", "o-"),
        ("train_success_rate", "training, with exploration", ":"),
    ):
        ax.plot(epochs, [row[column] for row in rows], style, markersize=3, label=label)
    ax.set(xlabel="epoch", ylabel="success rate", ylim=(-0.03, 1.03))
    ax.set_title(f"{title['method'].upper()} on {title['env']}, seed {title['seed']}")
    ax.legend(loc="lower right")
    ax.grid(alpha=0.3)
    fig.savefig(folder / "curve.png", dpi=110)
    plt.close(fig)


def _commit() -> str | None:
    """The commit of the code that ran, or None outside a git checkout."""
    here = Path(__file__).parent
    try:
        git = subprocess.run(
            ["git", "-C", here, "describe", "--always", "--dirty", "--abbrev=40"],
            capture_output=True,
            text=True,
        )
    except FileNotFoundError:  # no git on this machine
        return None
    return git.stdout.strip() or None
