"""The paper's figures, and the tables by task, from results/ alone:

    python -m experiments.figures NAME [--runs DIR]

reads config.json and progress.csv of every run below results/, or below DIR (for fig3, fig5 and
fig8 what experiments/didactic.py left there), and writes NAME.png there. "all" is all of them. For
"summary" it writes each task's table and curves.png into <env>/, and a line a task into
README.md. What a run is follows from its settings, whatever its folder is called.
"""

import argparse
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
from harness.errors import UsageError
from harness.records import read_rows
from harness.settings import Config

# Okabe and Ito's colours, which colour-blind people can tell apart, and dashes for print
COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"]
DASHES = ["-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)), (0, (3, 1, 1, 1))]
SHOWN = (1, 2, 5, 10, 20, 50)  # epochs in a task's table, beside the last
BEGIN = "<!-- python -m experiments.figures summary writes what stands from here -->"
END = "<!-- to here -->"
Lines = dict[str, list[np.ndarray]]  # by label: a curve for each run


class Missing(Exception):
    """There are no runs for a figure."""


@dataclass
class Run:
    config: Config
    gpu: bool  # whether it was trained on one
    rows: dict[str, np.ndarray]  # the columns of progress.csv, (epochs,) each

    @property
    def success(self) -> np.ndarray:
        return self.rows["test_success_rate"]


def read_runs(folder: Path) -> list[Run]:
    """Every run below `folder`, those on a GPU last and else by seed. UsageError for one of another
    version."""
    runs = []
    for file in folder.rglob("progress.csv"):
        if not (file.parent / "config.json").exists():  # other programs write a progress.csv too
            continue
        saved = settings.load(file.parent)
        if rows := read_rows(file.parent):
            columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
            config = settings.complete(replace(saved, device="cpu"))
            runs.append(Run(config, saved.device == "cuda", columns))
    return sorted(runs, key=lambda run: (run.gpu, run.config.seed, run.config.out))


Tasks = dict[tuple[str, str], dict[str, list[Run]]]  # the runs by (folder, schedule), then label


def is_papers(c: Config, times: int = 1) -> bool:
    """Whether the schedule is Appendix B's, with so many times the updates."""
    paper = settings.paper_schedule(c.env, c.method)
    paper["updates"] *= times
    return paper == {name: getattr(c, name) for name in paper}


# Settings that the panel's title or the label's own words say, or that need no saying.
SAID_ELSEWHERE = ("cycles", "updates", "batch_size", "eval_episodes", "heads", "priority")


def label(c: Config) -> str:
    """What the legend calls the run: its method and what is not the paper's default."""
    parts = [c.method.upper()]
    if c.heads == 1 and is_papers(c, 16):  # those that an ensemble of 16 makes
        parts.append("16 times the updates")
    if c.heads != (16 if c.method == "vcp" else 1):
        parts.append(f"{c.heads} heads")
    if c.priority != "consistency":
        parts.append(f"{c.priority} priority")
    others = {n: x for n, x in settings.differences(c).items() if n not in SAID_ELSEWHERE}
    return ", ".join(parts + [f"{name} {x}" for name, x in others.items()])


def schedule(c: Config) -> str:
    """What is other than in Appendix B, for a title."""
    if is_papers(c) or (c.heads == 1 and is_papers(c, 16)):
        return ""
    return f"{c.cycles} cycle{'s' * (c.cycles > 1)} of {c.updates} updates of batch {c.batch_size}"


def by_task(runs: list[Run]) -> Tasks:
    """The runs by task, the paper's schedule first; in these by label, VCP's first."""
    tasks = defaultdict(lambda: defaultdict(list))
    for run in sorted(runs, key=lambda run: (run.config.method != "vcp", label(run.config))):
        folder = settings.default_folder(run.config).split("/")[0]  # called by the environment
        tasks[folder, schedule(run.config)][label(run.config)].append(run)
    return dict(sorted(tasks.items()))


# ------------------------------------------------------------------------------ numbers

# Student's t, 0.975, by the number of seeds; for fewer no interval is given
T_975 = {5: 2.776, 6: 2.571, 7: 2.447, 8: 2.365, 9: 2.306, 10: 2.262}


def interval(x: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The 95 % interval of the mean over the first axis, seeds, by Student's t: (S, ...) -> (...).
    None for fewer than 5 seeds; for more than 10 that of 10, a little too wide."""
    if len(x) < min(T_975):
        return None
    half = T_975.get(len(x), T_975[10]) * x.std(axis=0, ddof=1) / np.sqrt(len(x))
    return x.mean(axis=0) - half, x.mean(axis=0) + half


def said(x: np.ndarray, sign: str = "") -> str:
    """The mean over seeds with its interval, or with the seeds' own numbers where they are few.
    sign: "+" for differences."""

    def number(value):
        return f"{np.round(value, 3) + 0.0:{sign}.3f}"  # no -0.000

    if len(x) == 1:
        return number(x[0])
    ends = interval(x)
    if ends:
        return f"{number(x.mean())} ±{(ends[1] - ends[0]) / 2:.3f}"
    return f"{number(x.mean())} ({' '.join(map(number, x))})"


def pairs(ours: list[Run], theirs: list[Run]) -> list[tuple[Run, Run]]:
    """Runs of the same seed: on the same kind of machine and, of a seed that has no such pair, on
    different ones."""
    both = [(a, b) for a in ours for b in theirs if a.config.seed == b.config.seed]
    found = [(a, b) for a, b in both if a.gpu == b.gpu]
    paired = {a.config.seed for a, _ in found}
    return found + [(a, b) for a, b in both if a.config.seed not in paired]


def table(methods: dict[str, list[Run]], epochs: int) -> list[str]:
    """A task's methods over the first `epochs`, of the runs that have them."""
    long = {name: [r for r in runs if len(r.success) >= epochs] for name, runs in methods.items()}
    shown = sorted({*(epoch for epoch in SHOWN if epoch < epochs), epochs})
    columns = ["method", "seeds", f"success after epochs {', '.join(map(str, shown))}"]
    columns += [f"mean of {epochs} epochs", "VCP ahead by"]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for name, runs in long.items():
        if not runs:
            continue
        curves = np.stack([run.success[:epochs] for run in runs])
        compared = pairs(long.get("VCP", []), runs) if name != "VCP" else []
        ahead = [np.mean(a.success[:epochs] - b.success[:epochs]) for a, b in compared]
        seeds = ",".join(f"{'g' * run.gpu}{run.config.seed}" for run in runs)
        cells = [name, seeds, " ".join(f"{curves[:, e - 1].mean():.2f}" for e in shown)]
        cells += [said(curves.mean(axis=1)), said(np.array(ahead), "+") if ahead else ""]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def put(path: Path, lines: list[str]) -> None:
    """Write the lines between the two marks of a text, or at its end if it has none."""
    before, _, rest = (path.read_text() if path.exists() else "").partition(BEGIN)
    text, after = "\n".join(lines).strip(), rest.partition(END)[2] or "\n"
    path.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}")


def tables(tasks: Tasks) -> dict[str, list[str]]:
    """The lines for each README.md: of a task over the epochs that all its runs have, and over as
    many as VCP's longest run; and of all tasks a line each."""
    columns = ("VCP", "VCP, uniform priority", "HER, 16 heads", "HER")
    heads = ("task", "epochs", *columns)
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    texts = defaultdict(list, {"README.md": lines})
    for (folder, plan), methods in tasks.items():
        name = f"{folder}/README.md"
        shortest = min(len(run.success) for runs in methods.values() for run in runs)
        longest = max((len(run.success) for run in methods.get("VCP", [])), default=shortest)
        for epochs in sorted({shortest, longest}):
            heading = f"{plan or 'Schedule of Appendix B'}, {epochs} epochs:"
            texts[name] += ["", heading, "", *table(methods, epochs)]
        cells = [f"[{folder}]({name}){plan and f', {plan}'}", str(shortest)]
        for method in columns:
            means = [run.success[:shortest].mean() for run in methods.get(method, [])]
            cells.append(f"{np.mean(means):.2f} ({len(means)})" if means else "")
        lines.append(f"| {' | '.join(cells)} |")
    return texts


def panels_of(plan: str, methods: dict[str, list[Run]]) -> dict[str, Lines]:
    """What there is to compare on a task, by panels of its figure."""
    variants, panels = [name for name in methods if name.startswith("VCP")], {}
    parts = {"VCP and one network": ONE_NETWORK, "16 heads": ENSEMBLES, "variants of VCP": variants}
    for text, names in parts.items():
        chosen = {name: methods[name] for name in names if name in methods}
        if len(chosen) > 1:
            panels["\n".join(filter(None, (text, plan)))] = success(chosen)
    return panels or {plan: success(methods)}


def summary(runs: list[Run], results: Path) -> Path:
    """Write the tables and the tasks' figures, without runs that were stopped before their last
    epoch."""
    if not runs:
        raise Missing
    tasks = by_task([run for run in runs if len(run.success) >= run.config.epochs])
    panels = defaultdict(dict)
    for (folder, plan), methods in tasks.items():
        panels[folder] |= panels_of(plan, methods)
    for folder, drawn in panels.items():
        (results / folder).mkdir(exist_ok=True)
        curves(drawn, folder).savefig(results / folder / "curves.png", dpi=100)
    for name, lines in tables(tasks).items():
        put(results / name, lines)
    return results / "README.md"


# ------------------------------------------------------------------------------ pictures

ONE_NETWORK = ("VCP", "HER", "HER, 16 times the updates", "HEREBP", "CHER", "DTGSH")
ENSEMBLES = ("VCP", "HER, 16 heads", "HEREBP, 16 heads", "CHER, 16 heads", "DTGSH, 16 heads")
ABLATIONS = ("VCP", "VCP, uniform priority", "VCP, variance priority", "VCP, acting_head one")
SIZES = ("VCP", *(f"VCP, {k} heads" for k in didactic.SIZES))
FIGURES = {  # name: (what it is, which runs by their label)
    "fig2": ("Figure 2: VCP (16 heads) and the other methods with one network", ONE_NETWORK),
    "fig4": ("Figure 4: the variance on hindsight and on original transitions", ("VCP",)),
    "fig6": ("Figure 6: ablations of VCP", ABLATIONS),
    "fig7": ("Figure 7: VCP with ensembles of other sizes", SIZES),
    "fig9": ("Figure 9: VCP and the other methods with the same ensemble", ENSEMBLES),
}


def success(methods: dict[str, list[Run]]) -> Lines:
    return {name: [run.success for run in runs] for name, runs in methods.items()}


def draw_line(ax: Axes, seeds: list[np.ndarray], style: int, text: str) -> None:
    """The mean over seeds by epoch, as far as all of them have come, and its interval; where the
    seeds are too few for one, a thin line for each of them."""
    shortest = min(map(len, seeds))
    y = np.stack([seed[:shortest] for seed in seeds])
    epochs, number = np.arange(1, shortest + 1), len(COLOURS)
    dash = DASHES[(style + style // number) % number]
    how = {"color": COLOURS[style % number], "linestyle": dash}
    ax.plot(epochs, y.mean(axis=0), **how, label=text, marker="o" if shortest == 1 else "")
    if ends := interval(y):
        ax.fill_between(epochs, *ends, color=how["color"], alpha=0.15, linewidth=0)
    elif len(seeds) > 1:
        for seed in seeds:
            ax.plot(np.arange(1, len(seed) + 1), seed, **how, linewidth=0.7, alpha=0.6)


def curves(panels: dict[str, Lines], title: str, what: str = "test success rate") -> Figure:
    """A panel for each title, in it a line for each label. A rate's axis ends at 1, or at 0.1 where
    no run is above 0.1. Another thing than a rate is drawn on a logarithmic scale."""
    names = list(dict.fromkeys(name for methods in panels.values() for name in methods))
    columns = min(len(panels), 3)
    lines = -(-len(panels) // columns)
    fig = Figure(figsize=(8.3, 2.9 * lines + 1.1), layout="constrained")
    axes = fig.subplots(lines, columns, squeeze=False, sharey="rate" not in what).flat
    entries = {}
    for ax, (text, methods) in zip(axes, panels.items(), strict=False):
        for name, seeds in methods.items():
            draw_line(ax, seeds, names.index(name), name)
        few, many = min(map(len, methods.values())), max(map(len, methods.values()))
        number = f"{few}" if few == many else f"{few} to {many}"
        ax.set_title(f"{text}\n{number} run{'s' * (many > 1)}".strip(), fontsize=8)
        top = 1 if max(x.max() for seeds in methods.values() for x in seeds) > 0.1 else 0.1
        rate = {"ylim": (-0.03 * top, 1.03 * top)}
        ax.set(xlabel="epoch", **(rate if "rate" in what else {"yscale": "log"}))
        ax.xaxis.get_major_locator().set_params(integer=True)
        ax.grid(alpha=0.3)
        entries |= dict(zip(*ax.get_legend_handles_labels()[::-1], strict=True))
    for ax in list(fig.axes)[len(panels) :]:
        ax.axis("off")
    handles = [entries[name] for name in names]
    fig.legend(handles, names, loc="outside lower center", ncols=3, fontsize=9, handlelength=3)
    fig.supylabel(what, fontsize=10)
    means = "mean over seeds, with a 95 % interval from 5 on and each seed's line for fewer"
    if len({ax.get_ylim() for ax in fig.axes[: len(panels)]}) > 1 and "rate" in what:
        means += "\nthe axis ends at 0.1 where no run is above that"
    fig.suptitle(f"{title}\n{means}", fontsize=10)
    return fig


def paper_figure(name: str, runs: list[Run]) -> Figure:
    """A panel for each task in which there is something to compare VCP with or, if there is none,
    for each task; of Figure 4 for each. Missing without runs to compare."""
    runs = [run for run in runs if label(run.config) in FIGURES[name][1]]
    if len({label(run.config) for run in runs}) < (1 if name in ("fig2", "fig4") else 2):
        raise Missing
    tasks = {"\n".join(filter(None, task)): methods for task, methods in by_task(runs).items()}
    title = f"{FIGURES[name][0]}; Appendix B's schedule unless said"
    if name == "fig4":
        kinds = {kind: f"variance_{kind}" for kind in ("hindsight", "original")}
        panels = {
            task: {k: [run.rows[column] for run in methods["VCP"]] for k, column in kinds.items()}
            for task, methods in tasks.items()
        }
        return curves(panels, title, "variance of the 16 Q-values")
    compared = {task: methods for task, methods in tasks.items() if {"VCP"} < methods.keys()}
    return curves({task: success(m) for task, m in (compared or tasks).items()}, title)


def overview(runs: list[Run]) -> Figure:
    """README's figure: four methods on three tasks."""
    names = ("VCP", "VCP, uniform priority", "HER, 16 heads", "HER")
    found = by_task(runs)
    tasks = {t: found.get((t, ""), {}) for t in ("FetchReach-v1", "FetchPush-v1", "HandReach-v0")}
    if not all({*names} <= methods.keys() for methods in tasks.values()):
        raise Missing
    panels = {t: success({name: methods[name] for name in names}) for t, methods in tasks.items()}
    return curves(panels, "HER has one network, the others have 16 heads")


def priority_figure(runs: list[Run]) -> Figure:
    """What Eq. (4), over B_h and within each kind, is ahead of uniform priority in the mean success
    of the epochs that both have: a point a seed, with the mean and its interval."""
    arms = defaultdict(lambda: defaultdict(list))
    for run in runs:
        if run.config.method == "vcp":
            rest = label(replace(run.config, priority="consistency")).removeprefix("VCP")
            task = f"{run.config.env}, {schedule(run.config)}{rest}".replace(" of ", "\nof ", 1)
            arms[task.removesuffix(", ")][run.config.priority].append(run)
    arms = {task: found for task, found in arms.items() if {"uniform", "consistency"} <= set(found)}
    if not arms:
        raise Missing
    fig = Figure(figsize=(8.3, 0.6 * len(arms) + 1), layout="constrained")
    ax = fig.subplots()
    words = {"consistency": "Eq. (4)", "within-kind": "Eq. (4) within each kind"}
    for style, (priority, text) in enumerate(words.items()):
        how = {"color": COLOURS[style], "label": text}
        for y, found in enumerate(arms.values()):
            compared = [
                [run.success[: min(len(a.success), len(b.success))].mean() for run in (a, b)]
                for a, b in pairs(found[priority], found["uniform"])
            ]
            if compared:
                ahead = np.subtract(*np.transpose(compared))
                place = np.full(len(ahead), y + 0.3 * style - 0.15)
                ax.plot(ahead, place, "os"[style], alpha=0.5, markersize=5, **how)
                ends = interval(ahead)
                ax.plot(ends or ahead.mean(), place[: 2 if ends else 1], "-|", color=how["color"])
                how.pop("label", None)
    ax.axvline(0, color="0.5", linewidth=1)
    ax.set_yticks(range(len(arms)), arms, fontsize=8)
    ax.set(xlabel="mean success, ahead of uniform priority", ylim=(len(arms) - 0.5, -0.5))
    ax.grid(axis="x", alpha=0.3)
    fig.legend(loc="outside upper center", ncols=2)
    return fig


# ------------------------------------------------------------------------------ the program

OURS = {"overview": overview, "priority": priority_figure}
NAMES = [*sorted([*FIGURES, *didactic.DRAWN]), *OURS, "summary"]


def draw(name: str, results: Path = RESULTS) -> Path:
    """Write NAME.png, or the tables for "summary", into `results`, and give its path. SystemExit,
    with what to do, if something for it is missing."""
    try:
        if name in didactic.DRAWN:
            figure = didactic.DRAWN[name](results / "didactic")
        elif name == "summary":
            return summary(read_runs(results), results)
        else:
            runs = read_runs(results)
            figure = OURS[name](runs) if name in OURS else paper_figure(name, runs)
    except FileNotFoundError as error:
        sys.exit(f"figures.py: {error.filename} is missing: experiments.didactic")
    except ModuleNotFoundError as error:
        sys.exit(f"figures.py: {name}: {error}: pip install -r requirements-experiments.txt")
    except Missing:
        sys.exit(f"figures.py: {name} compares runs that are not in {results}")
    path = results / f"{name}.png"
    figure.savefig(path, dpi=100)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0].rstrip(":"))
    parser.add_argument("name", choices=[*NAMES, "all"], help="the picture, or the table, to make")
    parser.add_argument(
        "--runs", type=Path, default=RESULTS, metavar="DIR", help="your own (default: results/)"
    )
    given = parser.parse_args()
    if not given.runs.is_dir():
        parser.error(f"there is no folder {given.runs}")
    for name in NAMES if given.name == "all" else [given.name]:
        try:
            print(draw(name, given.runs))
        except UsageError as error:
            parser.error(str(error))
        except SystemExit as missing:  # the others can be drawn
            if given.name != "all":
                raise
            print(missing, file=sys.stderr)


if __name__ == "__main__":
    main()
