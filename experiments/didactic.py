"""Figures 3, 5 and 8, from runs on PointMassEmpty: python -m experiments.didactic

Trains the runs below runs/didactic, or goes on with them, and writes what the figures need of their
networks and buffers to results/didactic/NAME.npz. Figure 5 needs its runs at epochs 1, 4 and 10;
one that is past such an epoch is refused. The second half of this file draws the figures from these
arrays; `experiments.figures` calls it.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import run
from experiments.inspect_run import effective_share
from harness import records, settings
from harness.assemble import Parts, restored
from harness.errors import UsageError
from harness.settings import Config

RESULTS = Path(__file__).parent.parent / "results"
SCHEDULE = {"env": "PointMassEmptyEnv-v1", "updates": 5, "batch_size": 64}
EPOCH = 10  # of Figures 3 and 8
SHOWN = 1000  # points of each kind that are kept for Figure 5
SIZES = (2, 4, 8, 16, 32)  # K of Figure 8
TRAJECTORIES = 5
STAGES = (1, 4, 10)  # epochs of Figure 5
MAPPED = 500  # points of each kind; t-SNE takes its time
PRIORITIES = {"consistency": "lower variance first", "variance": "higher variance first"}
BLUE, GREEN, RED = "#0072B2", "#009E73", "#D55E00"


def trained(config: Config, epoch: int) -> Parts:
    """The run's parts after `epoch` epochs; it is trained as far as needed. UsageError for a run
    that is past that epoch: its checkpoint is a later one's."""
    config = settings.complete(replace(config, epochs=epoch))
    folder = Path(config.out)
    done = records.epochs_done(folder)
    if done > epoch:
        raise UsageError(f"{folder} has {done} epochs, not {epoch}: remove it or choose an --out")
    if done < epoch:
        run.train(config, resume=(folder / "config.json").exists())
    return restored(folder)[0]


def figure_3(config: Config) -> dict[str, np.ndarray]:
    """Section 5.3: the variance of a random state ŝ and its action with each achieved goal of its
    own trajectory, and the heads' mean value. xy (5, T+1, 2); t (5,), the step of ŝ; variance and
    value (5, T+1). Section 5.4: of all transitions of B_h, her_variance and her_value (N,).

    The trajectories are the five longest of one episode of each head, played with exploration."""
    parts = trained(config, EPOCH)
    agent, rng = parts.agent, np.random.default_rng(0)

    def value(obs, goal):  # 1/K Σ_k Q_k(s, μ_k(s, g), g)
        return agent.value(*(np.repeat(x[None], agent.num_heads, 0) for x in (obs, goal))).mean(0)

    with parts.envs() as envs:
        envs.reset(1_000_000)
        noise = run.exploration(rng, (50, 16, 2), 0.2, 0.3)
        episodes, _ = run.rollout(envs, run.acting_heads(agent, 16, 16, noise), 50)
    length = np.linalg.norm(np.diff(episodes["obs"], axis=1), axis=-1).sum(axis=1)
    rows = np.argsort(-length)[:TRAJECTORIES]
    t = rng.integers(50, size=TRAJECTORIES)
    variances, values = [], []
    for row, step in zip(rows, t, strict=True):
        obs, action = (np.repeat(episodes[k][row, [step]], 51, axis=0) for k in ("obs", "action"))
        goal = episodes["achieved_goal"][row]
        variances.append(agent.q_variance(obs, action, goal))
        values.append(value(obs, goal))
    her = {name: x[: parts.her_buffer.size] for name, x in parts.her_buffer.data.items()}
    return {
        "xy": episodes["obs"][rows],
        "t": t,
        "variance": np.stack(variances),
        "value": np.stack(values),
        "her_variance": agent.q_variance(her["obs"], her["action"], her["goal"]),
        "her_value": value(her["obs"], her["goal"]),
    }


def figure_5(config: Config) -> dict[str, np.ndarray]:
    """Section 5.5: states and goals, (SHOWN, 4), in B_o, in B_h and drawn from B_h by priority, at
    each stage."""
    points = {}
    for epoch in STAGES:
        parts = trained(config, epoch)
        original, her_buffer = parts.original_buffer, parts.her_buffer
        rng = np.random.default_rng(epoch)
        e, t = rng.integers(original.size, size=SHOWN), rng.integers(50, size=SHOWN)
        i = rng.choice(her_buffer.size, SHOWN, replace=False)
        drawn = her_buffer.sample(SHOWN, rng)
        kinds = {
            "original": [original.episodes["obs"][e, t], original.episodes["desired_goal"][e]],
            "her": [her_buffer.data[name][i] for name in ("obs", "goal")],
            "drawn": [drawn["obs"], drawn["goal"]],
        }
        points |= {f"{kind}_{epoch}": np.hstack(arrays) for kind, arrays in kinds.items()}
        points[f"effective_{epoch}"] = np.array(effective_share(her_buffer.probabilities))
    return {name: x.astype(np.float32) for name, x in points.items()}


def figure_8(config: Config) -> dict[str, np.ndarray]:
    """Section 5.8: of every transition of B_h the variance now, the probability to be drawn, and
    whether it is hindsight's, (N,) each."""
    parts = trained(config, EPOCH)
    agent, her_buffer = parts.agent, parts.her_buffer
    rows = {name: x[: her_buffer.size] for name, x in her_buffer.data.items()}
    return {
        "variance": agent.q_variance(rows["obs"], rows["action"], rows["goal"]),
        "probability": her_buffer.probabilities.astype(np.float32),
        "hindsight": rows["hindsight"],
    }


# ------------------------------------------------------------------------------ pictures


def rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Spearman's, of two arrays (N,)."""
    return float(np.corrcoef(*(np.argsort(np.argsort(a)) for a in (x, y)))[0, 1])


def distance_correlation(data: dict[str, np.ndarray]) -> list[float]:
    """The rank correlation between the distance of a goal from ŝ and the variance of the pair, for
    each trajectory."""
    return [
        rank_correlation(np.linalg.norm(xy - xy[t], axis=1), variance)
        for xy, t, variance in zip(data["xy"], data["t"], data["variance"], strict=True)
    ]


def draw_figure_3(folder: Path) -> Figure:
    """Figure 3: trajectories, coloured by the variance of (ŝ, its action, each achieved goal)."""
    data = np.load(folder / "fig3.npz")
    fig = Figure(figsize=(8.3, 5.6), layout="constrained")
    panels = list(fig.subplots(2, 3).flat)
    colour = np.log10(data["variance"])
    limits = {"vmin": colour.min(), "vmax": colour.max(), "cmap": "viridis"}
    with_value = [*map(rank_correlation, data["value"], data["variance"])]
    for ax, xy, t, variance, r, q in zip(
        panels, data["xy"], data["t"], colour, distance_correlation(data), with_value, strict=False
    ):
        ax.plot(*xy.T, color="0.8", linewidth=1, zorder=0)
        points = ax.scatter(*xy.T, c=variance, s=14, **limits)
        ax.plot(*xy[0], "o", color=RED, markersize=7, label="start")
        ax.plot(*xy[-1], "s", color=BLUE, markersize=7, label="end")
        ax.plot(*xy[t], "k^", markersize=9, label="ŝ")
        ax.set_title(f"distance {r:+.2f}, value {q:+.2f}", fontsize=9)
        ax.set(aspect="equal", xlim=(-0.62, 0.62), ylim=(-0.62, 0.62), xticks=[], yticks=[])
    panels[-1].axis("off")
    fig.legend(*fig.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    fig.colorbar(points, ax=fig.axes, shrink=0.8, label="log₁₀ of the variance")
    in_buffer = rank_correlation(data["her_value"], data["her_variance"])
    fig.suptitle(
        "Figure 3: variance of ŝ with each achieved goal of its trajectory, and its rank\n"
        f"correlation with distance and value ({in_buffer:+.2f} with the value in all of B_h);\n"
        "PointMassEmptyEnv-v1, 5 updates of batch 64 a cycle, one seed",
        fontsize=10,
    )
    return fig


def draw_figure_5(folder: Path) -> Figure:
    """Figure 5: where B_o, B_h and what is drawn from B_h lie, in a t-SNE map of (state, goal) that
    is common to a row; and the density of what is drawn."""
    from scipy.stats import gaussian_kde  # of requirements-experiments.txt
    from sklearn.manifold import TSNE

    data = {priority: np.load(folder / f"fig5_{priority}.npz") for priority in PRIORITIES}
    fig = Figure(figsize=(8.3, 2.4 * len(STAGES) + 0.8), layout="constrained")
    panels = fig.subplots(len(STAGES), 4)
    for line, epoch in zip(panels, STAGES, strict=True):
        kinds = [f"{kind}_{epoch}" for kind in ("original", "her", "drawn")]
        both = [data[priority][kind][:MAPPED] for priority in PRIORITIES for kind in kinds]
        mapped = TSNE(random_state=0, init="pca").fit_transform(np.concatenate(both))
        parts = np.split(mapped, np.cumsum([len(x) for x in both])[:-1])
        for i, (priority, what) in enumerate(PRIORITIES.items()):
            original, her, drawn = parts[3 * i : 3 * i + 3]
            effective = float(data[priority][f"effective_{epoch}"])
            points, density = line[2 * i], line[2 * i + 1]
            points.scatter(*original.T, s=2, color=BLUE, label="B_o")
            points.scatter(*her.T, s=2, color=GREEN, label="B_h")
            points.scatter(*drawn.T, s=2, color=RED, label="drawn")
            points.set_title(f"epoch {epoch},\n{what}", fontsize=9)
            x, y = np.meshgrid(
                *(np.linspace(*np.quantile(mapped[:, k], [0, 1]), 60) for k in (0, 1))
            )
            shade = gaussian_kde(drawn.T)(np.stack([x.ravel(), y.ravel()])).reshape(x.shape)
            density.pcolormesh(x, y, shade, cmap="viridis")
            density.set_title(f"drawn: as good as\n{effective:.2%} of B_h", fontsize=9)
            for ax in (points, density):
                ax.set(xticks=[], yticks=[])
    handles = panels[0, 0].get_legend_handles_labels()
    fig.legend(*handles, loc="outside lower center", ncols=3, markerscale=5)
    fig.suptitle(
        "Figure 5: what is drawn, and its density (effective sample size); PointMassEmptyEnv-v1,\n"
        "half originals, B_o and B_h of 10,000, 5 updates of batch 64 a cycle, one seed",
        fontsize=10,
    )
    return fig


def draw_figure_8(folder: Path) -> Figure:
    """Figure 8: histograms of the variance in B_h for ensembles of K heads, and how often the
    priority draws an original transition (Section 5.8)."""
    data = {k: dict(np.load(folder / f"fig8_{k}.npz")) for k in SIZES}
    fig = Figure(figsize=(6.4, 1.5 * len(data) + 1), layout="constrained")
    panels = fig.subplots(len(data), 1, sharex=True, squeeze=False)[:, 0]
    variances = np.concatenate([d["variance"] for d in data.values()])
    bins = np.geomspace(*np.quantile(variances[variances > 0], [0.001, 1]), 60)
    for ax, (k, d) in zip(panels, data.items(), strict=True):
        for kind, colour in ((True, BLUE), (False, RED)):
            variance = d["variance"][d["hindsight"] == kind]
            name = "hindsight" if kind else "original"
            ax.hist(variance, bins, color=colour, alpha=0.6, label=name)
            ax.axvline(np.median(variance), color=colour, linestyle="--", linewidth=1)
        original = ~d["hindsight"]
        share, drawn = original.mean(), d["probability"][original].sum()
        ax.set(xscale="log", ylabel=f"K = {k}")
        ax.set_title(f"originals: {share:.1%} of B_h, {drawn:.1%} of the draws", fontsize=9)
    handles = panels[0].get_legend_handles_labels()
    fig.legend(*handles, loc="outside lower center", ncols=2)
    panels[-1].set_xlabel("variance of the K Q-values in B_h (dashed: medians)")
    fig.suptitle(
        "Figure 8: PointMassEmptyEnv-v1, half originals,\n"
        "5 updates of batch 64 a cycle, epoch 10, one seed",
        fontsize=10,
    )
    return fig


DRAWN = {"fig3": draw_figure_3, "fig5": draw_figure_5, "fig8": draw_figure_8}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", default="runs/didactic", help="the runs (default: runs/didactic)")
    out = Path(parser.parse_args().out)

    def arrays_of(function, name, **settings):
        return function(Config(**SCHEDULE, **settings, out=str(out / name)))

    half = {"relabel_ratio": 0.5}  # Sections 5.5 and 5.8
    small = {**half, "buffer_size": 10_000, "her_buffer_capacity": 10_000}  # Figure 5's caption
    try:
        arrays = {"fig3": arrays_of(figure_3, "heads16")}
        for k in SIZES:
            arrays[f"fig8_{k}"] = arrays_of(figure_8, f"half{k}", **half, heads=k)
        for p in PRIORITIES:
            arrays[f"fig5_{p}"] = arrays_of(figure_5, f"small_{p}", **small, priority=p)
    except UsageError as error:
        parser.error(str(error))
    folder = RESULTS / "didactic"
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in arrays.items():  # after all runs, which note whether the work tree is clean
        np.savez_compressed(folder / f"{name}.npz", **values)
        print(folder / f"{name}.npz")


if __name__ == "__main__":
    main()
