"""The paper's figures from results/ alone: python -m experiments.figures NAME [--runs DIR]

Reads config.json and progress.csv of every run below results/, or below DIR, and writes NAME.png
there. What a run is follows from its settings, whatever its folder is called.
"""

import argparse
import math
import re
import sys
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments import didactic
from experiments.didactic import RESULTS
from harness import settings
from harness.records import read_rows
from harness.settings import Config

# Okabe and Ito's colours, which colour-blind people can tell apart, and dashes for print
COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"]
DASHES = ["-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)), (0, (3, 1, 1, 1))]
BASELINES = ("her", "herebp", "cher", "dtgsh")


@dataclass
class Run:
    config: Config
    rows: dict[str, np.ndarray]  # the columns of progress.csv, (epochs,) each


def read_runs(folder: Path) -> list[Run]:
    """Every run below `folder`."""
    runs = []
    for file in sorted(folder.rglob("progress.csv")):
        rows = read_rows(file.parent)
        if rows:
            columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
            config = replace(settings.load(file.parent), device="cpu")
            runs.append(Run(settings.complete(config), columns))
    return runs


def paper_schedule(c: Config) -> tuple[int, int, int]:
    """Appendix B's cycles, updates and batch size."""
    return tuple(settings.paper_schedule(c.env, c.method).values())[:3]


def as_many_updates(c: Config) -> bool:
    """Whether one network makes the updates that an ensemble of 16 makes."""
    cycles, updates, batch_size = paper_schedule(c)
    same = (c.cycles, c.updates, c.batch_size) == (cycles, 16 * updates, batch_size)
    return c.heads == 1 and same


# Settings that the panel's title or the label's own words say, or that need no saying.
SCHEDULE = ("cycles", "updates", "batch_size")
SAID_ELSEWHERE = (*SCHEDULE, "eval_episodes", "heads", "priority", "acting_head")


def label(c: Config) -> str:
    """What the legend calls the run: its method and what is not the paper's default."""
    parts = [c.method.upper()]
    if as_many_updates(c):
        parts.append("16 times the updates")
    if c.heads != (16 if c.method == "vcp" else 1):
        parts.append(f"{c.heads} heads")
    if c.priority != "consistency":
        parts.append(f"{c.priority} priority")
    if c.acting_head == "one":
        parts.append("one acting head")
    others = settings.differences(c).items()
    return ", ".join(parts + [f"{name} {x}" for name, x in others if name not in SAID_ELSEWHERE])


ABLATIONS = ("VCP", "VCP, uniform priority", "VCP, variance priority", "VCP, one acting head")
FIGURES = {  # name: (what it is, which runs by their label)
    "fig2": (
        "Figure 2: VCP (16 heads) and the other methods with one network",
        lambda name: name in ("VCP", *map(str.upper, BASELINES), "HER, 16 times the updates"),
    ),
    "fig4": ("Figure 4", lambda name: name == "VCP, relabel_ratio 0.5"),
    "fig6": ("Figure 6: ablations of VCP", lambda name: name in ABLATIONS),
    "fig7": (
        "Figure 7: VCP with ensembles of other sizes",
        lambda name: re.fullmatch(r"VCP(, \d+ heads)?", name),
    ),
    "fig9": (
        "Figure 9: VCP and the other methods with the same ensemble",
        lambda name: name in ("VCP", *(f"{m.upper()}, 16 heads" for m in BASELINES)),
    ),
}


def smoothed(x: np.ndarray, weight: float) -> np.ndarray:
    """Exponential moving average along the last axis; 0 leaves x as it is."""
    y = x.astype(float)
    for t in range(1, x.shape[-1]):
        y[..., t] = weight * y[..., t - 1] + (1 - weight) * x[..., t]
    return y


# Student's t, 0.975, by the number of seeds; for fewer no interval is given
T_975 = {5: 2.776, 6: 2.571, 7: 2.447, 8: 2.365, 9: 2.306, 10: 2.262}


def interval(x: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The 95 % interval of the mean over the first axis, seeds, by Student's t: (S, ...) -> (...).
    None for fewer than 5 seeds; for more than 10 that of 10, a little too wide."""
    if len(x) < min(T_975):
        return None
    half = T_975.get(len(x), T_975[10]) * x.std(axis=0, ddof=1) / np.sqrt(len(x))
    return x.mean(axis=0) - half, x.mean(axis=0) + half


def said(x: np.ndarray) -> str:
    """The mean over seeds with its interval, or with the seeds' own numbers where they are few."""
    ends = interval(x)
    spread = "{:.3f}-{:.3f}".format(*ends) if ends else " ".join(f"{seed:.3f}" for seed in x)
    return f"{x.mean():.3f} ({spread})" if len(x) > 1 else f"{x.mean():.3f}"


def draw_line(ax: Axes, seeds: list[np.ndarray], style: int, text: str, smooth: float) -> None:
    """The mean over seeds by epoch, as far as all of them have come, and its interval; where the
    seeds are too few for one, a thin line for each of them."""
    seeds = [smoothed(seed, smooth) for seed in seeds]
    shortest = min(map(len, seeds))
    y = np.stack([seed[:shortest] for seed in seeds])
    epochs = np.arange(1, shortest + 1)
    how = {"color": COLOURS[style], "linestyle": DASHES[style]}
    marker = "o" if shortest == 1 else ""  # a line of one
    ax.plot(epochs, y.mean(axis=0), **how, label=text, marker=marker)
    ends = interval(y)
    if ends:
        ax.fill_between(epochs, *ends, color=COLOURS[style], alpha=0.15, linewidth=0)
    elif len(seeds) > 1:
        for seed in seeds:
            ax.plot(np.arange(1, len(seed) + 1), seed, **how, linewidth=0.7, alpha=0.6)


def schedule(c: Config) -> str:
    """What is other than in Appendix B, for a title: nothing or a line."""
    if (c.cycles, c.updates, c.batch_size) == paper_schedule(c) or as_many_updates(c):
        return ""
    return f"\n{c.cycles} cycles of {c.updates} updates of batch {c.batch_size}"


def curves(runs: list[Run], title: str, smooth: float) -> Figure:
    """A panel for each environment in which there is something to compare VCP with or, if there is
    none, for each environment: test success by epoch of every method in `runs`."""
    runs = sorted(runs, key=lambda r: (r.config.method != "vcp", label(r.config) != "VCP"))
    names = list(dict.fromkeys(label(run.config) for run in runs))
    by_env = defaultdict(lambda: defaultdict(list))
    for run in runs:
        by_env[run.config.env + schedule(run.config)][label(run.config)].append(
            run.rows["test_success_rate"]
        )
    compared = {env: runs for env, runs in by_env.items() if len(runs) > 1 and "VCP" in runs}
    by_env = compared or by_env
    columns = min(len(by_env), 3)
    lines = -(-len(by_env) // columns)
    fig = Figure(figsize=(8.3, 2.9 * lines + 1.1), layout="constrained")
    panels = fig.subplots(lines, columns, squeeze=False, sharey=True).flat
    entries = {}
    for ax, (env, methods) in zip(panels, sorted(by_env.items()), strict=False):
        for name, seeds in methods.items():
            draw_line(ax, seeds, names.index(name), name, smooth)
        few, many = min(map(len, methods.values())), max(map(len, methods.values()))
        seeds = f"{few}" if few == many else f"{few} to {many}"
        env, _, its_schedule = env.partition("\n")
        between = "\n" if len(env) > 20 else ", "
        panel = f"{env}{between}{seeds} seed{'s' * (many > 1)}\n{its_schedule}"
        ax.set_title(panel.strip(), fontsize=10)
        ax.set(xlabel="epoch", ylim=(-0.03, 1.03))
        ax.xaxis.get_major_locator().set_params(integer=True)
        ax.grid(alpha=0.3)
        entries |= dict(zip(*ax.get_legend_handles_labels()[::-1], strict=True))
    for ax in list(fig.axes)[len(by_env) :]:
        ax.axis("off")
    in_order = [name for name in names if name in entries]
    handles = [entries[name] for name in in_order]
    fig.legend(handles, in_order, loc="outside lower center", ncols=3, fontsize=9, handlelength=3)
    how = f"; smoothed, weight {smooth}" if smooth else ""
    fig.supylabel("test success rate", fontsize=10)
    means = "mean over seeds, with a 95 % interval from 5 on and each seed's line for fewer"
    fig.suptitle(f"{title}\n{means}; Appendix B's schedule unless said{how}", fontsize=10)
    return fig


def figure_4(runs: list[Run], smooth: float) -> Figure:
    """Figure 4: the critics' variance on hindsight and on original transitions, by epoch."""
    fig = Figure(figsize=(4.6, 3.4), layout="constrained")
    ax = fig.subplots()
    for i, kind in enumerate(("hindsight", "original")):
        draw_line(ax, [run.rows[f"variance_{kind}"] for run in runs], i, kind, smooth)
    ax.set(xlabel="epoch", ylabel="variance of the 16 Q-values", yscale="log")
    c = runs[0].config
    title = f"Figure 4: {c.env}, half originals, seeds: {len(runs)}{schedule(c)}"
    ax.set_title(title, fontsize=9)
    ax.grid(alpha=0.3)
    ax.legend()
    return fig


def interquartile_mean(x: np.ndarray) -> float:
    """The mean of the middle half of all entries (Agarwal et al., 2021)."""
    x = np.sort(x, axis=None)
    cut = len(x) // 4
    return float(x[cut : len(x) - cut].mean())


def summary(runs: list[Run], last: int = 5, draws: int = 2000) -> str:
    """Two tables. For each environment and method, over the epochs that all runs of the environment
    have and, if the longest of VCP has more, over as many, from the seeds that have them: the first
    with a success of 0.95 and the minutes that one took (medians over seeds), the mean success, and
    that of the last ones, as `said`. For each method that shares more than one environment with
    VCP, over the epochs that all runs have: the interquartile mean of all seeds' mean successes for
    both, on the shared ones, each of the same weight, with a bootstrap that draws seeds within
    each. Runs that were stopped before their last epoch are left out."""
    success = defaultdict(lambda: defaultdict(list))
    minutes = defaultdict(list)
    for run in runs:
        epochs = len(run.rows["epoch"])
        if epochs < run.config.epochs:
            continue
        key = run.config.env + schedule(run.config).replace("\n", ", ")
        success[key][label(run.config)].append(run.rows["test_success_rate"])
        minutes[key, label(run.config)].append(run.rows["wall_seconds"][-1] / epochs / 60)
    lines, means = [], defaultdict(dict)
    for env, methods in sorted(success.items()):
        shortest = min(len(curve) for seeds in methods.values() for curve in seeds)
        longest = max(map(len, methods.get("VCP", [])), default=shortest)
        for epochs in sorted({shortest, longest}):
            for name, seeds in sorted(methods.items()):
                seeds = [curve[:epochs] for curve in seeds if len(curve) >= epochs]
                if not seeds:
                    continue
                firsts = [np.flatnonzero(curve >= 0.95)[:1] + 1 for curve in seeds]
                first = np.median([f[0] if len(f) else np.inf for f in firsts])
                mean = np.array([curve.mean() for curve in seeds])
                end = np.array([curve[-last:].mean() for curve in seeds])
                columns = [
                    str(len(seeds)),
                    str(epochs),
                    "never" if np.isinf(first) else f"{first:g}",
                ]
                columns += [said(mean), said(end), f"{np.median(minutes[env, name]):.2f}"]
                lines.append(f"| {env} | {name} | {' | '.join(columns)} |")
                if epochs == shortest:
                    means[name][env] = mean

    def total(scores: list[np.ndarray]) -> str:
        seeds = math.lcm(*map(len, scores))  # so that each environment counts the same

        def middle(scores):
            return interquartile_mean(np.stack([np.repeat(x, seeds // len(x)) for x in scores]))

        if min(map(len, scores)) < min(T_975):
            return f"{middle(scores):.3f}"
        rng = np.random.default_rng(0)
        drawn = [middle([rng.choice(x, len(x)) for x in scores]) for _ in range(draws)]
        low, high = np.quantile(drawn, [0.025, 0.975])
        return f"{middle(scores):.3f} ({low:.3f}-{high:.3f})"

    totals = []
    for name, by_env in sorted(means.items()):
        shared = [env for env in by_env if env in means["VCP"]]
        if name != "VCP" and len(shared) > 1:
            both = (total([means[n][env] for env in shared]) for n in (name, "VCP"))
            totals.append(f"| {name} | {'; '.join(shared)} | {' | '.join(both)} |")
    columns = ("seeds", "epochs", "first at .95", "mean", f"last {last}", "minutes an epoch")
    head = [f"| environment | method | {' | '.join(columns)} |", "|---" * (2 + len(columns)) + "|"]
    tables = [*head, *lines]
    if totals:
        tables += ["", "| method | environments | interquartile mean of the mean | VCP's |"]
        tables += ["|---|---|---|---|"]
    return "\n".join([*tables, *totals]) + "\n"


def from_arrays(name: str, folder: Path) -> Figure:
    """fig3, fig5 or fig8, from the .npz files of experiments.didactic. FileNotFoundError if they
    are not there."""

    def load(stem):
        return dict(np.load(folder / f"{stem}.npz"))

    if name == "fig3":
        return didactic.draw_figure_3(load("fig3"))
    if name == "fig5":
        return didactic.draw_figure_5({p: load(f"fig5_{p}") for p in didactic.PRIORITIES})
    sizes = [int(file.stem.removeprefix("fig8_")) for file in folder.glob("fig8_*.npz")]
    if not sizes:
        raise FileNotFoundError(folder / "fig8_*.npz")
    return didactic.draw_figure_8({k: load(f"fig8_{k}") for k in sizes})


def draw(name: str, results: Path = RESULTS, smooth: float = 0.0) -> Path:
    """Write NAME.png, or .md for the summary, into `results`, and give its path."""
    path = results / f"{name}.png"
    if name in ARRAYS:
        try:
            from_arrays(name, results / "didactic").savefig(path, dpi=100)
        except FileNotFoundError as error:
            sys.exit(f"figures.py: {error.filename or error} is missing: experiments.didactic")
        except ModuleNotFoundError as error:
            sys.exit(f"figures.py: {name}: {error}: pip install -r requirements-experiments.txt")
        return path
    belongs = FIGURES[name][1] if name in FIGURES else lambda name: True
    chosen = [run for run in read_runs(results) if belongs(label(run.config))]
    kinds = {label(run.config) for run in chosen}
    if len(kinds) < (2 if name in ("fig6", "fig7", "fig9") else 1):
        sys.exit(f"figures.py: {name} compares runs that are not in {results}")
    if name == "summary":
        path = results / "summary.md"
        path.write_text(summary(chosen))
        return path
    title = FIGURES[name][0]
    if name == "fig4":
        fig = figure_4(chosen, smooth)
    else:
        fig = curves(chosen, title, smooth)
    fig.savefig(path, dpi=100)
    return path


ARRAYS = ("fig3", "fig5", "fig8")
NAMES = [*sorted([*FIGURES, *ARRAYS]), "summary"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("name", choices=[*NAMES, "all"], help="the picture, or the table, to make")
    parser.add_argument(
        "--smooth", type=float, default=0.0, help="of the curves; the paper's: 0.9, or 0.6"
    )
    parser.add_argument(
        "--runs", type=Path, default=RESULTS, metavar="DIR", help="your own (default: results/)"
    )
    given = parser.parse_args()
    if not given.runs.is_dir():
        parser.error(f"there is no folder {given.runs}")
    if given.name != "all":
        print(draw(given.name, given.runs, given.smooth))
        return
    for name in NAMES:
        try:
            print(draw(name, given.runs, given.smooth))
        except SystemExit as missing:  # the others can be drawn
            print(missing, file=sys.stderr)


if __name__ == "__main__":
    main()
