"""Figures 3, 5 and 8, of what `experiments.didactic` saved: functions from arrays to pictures."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

BLUE, GREEN, RED = "#0072B2", "#009E73", "#D55E00"
STAGES = (1, 4, 10)  # epochs of Figure 5
MAPPED = 500  # points of each kind; t-SNE takes its time
PRIORITIES = {"consistency": "lower variance first", "variance": "higher variance first"}


def ranks(x: np.ndarray) -> np.ndarray:
    return np.argsort(np.argsort(x)).astype(float)


def distance_correlation(data: dict[str, np.ndarray]) -> list[float]:
    """Spearman's rank correlation between the distance of a goal from ŝ and the variance of the
    pair, for each trajectory."""
    result = []
    for xy, t, variance in zip(data["xy"], data["t"], data["variance"], strict=True):
        distance = np.linalg.norm(xy - xy[t], axis=1)
        result.append(float(np.corrcoef(ranks(distance), ranks(variance))[0, 1]))
    return result


def figure_3(data: dict[str, np.ndarray]) -> Figure:
    """Figure 3: trajectories, coloured by the variance of (ŝ, its action, each achieved goal)."""
    n = len(data["xy"])
    fig = Figure(figsize=(2.6 * n, 3.2), layout="constrained")
    panels = fig.subplots(1, n)
    correlations = distance_correlation(data)
    for ax, xy, t, variance, r in zip(
        panels, data["xy"], data["t"], data["variance"], correlations, strict=True
    ):
        ax.plot(*xy.T, color="0.8", linewidth=1, zorder=0)
        points = ax.scatter(*xy.T, c=np.log10(variance), cmap="viridis", s=14)
        ax.plot(*xy[0], "o", color=RED, markersize=7, label="start")
        ax.plot(*xy[-1], "s", color=GREEN, markersize=7, label="end")
        ax.plot(*xy[t], "k^", markersize=9, label="ŝ")
        ax.set_title(f"rank correlation with\nthe distance: {r:+.2f}", fontsize=8)
        ax.set(aspect="equal", xlim=(-0.62, 0.62), ylim=(-0.62, 0.62), xticks=[], yticks=[])
        bar = fig.colorbar(points, ax=ax, shrink=0.7, location="bottom", ticks=MaxNLocator(4))
        bar.ax.tick_params(labelsize=6)
    panels[0].legend(fontsize=7)
    fig.suptitle(
        "Figure 3: log₁₀ of the variance of ŝ with each achieved goal of its trajectory\n"
        "PointMassEmptyEnv-v1, 5 updates of batch 64 a cycle, epoch 10, one seed",
        fontsize=9,
    )
    return fig


def figure_5(data: dict[str, dict[str, np.ndarray]]) -> Figure:
    """Figure 5: where B_o, B_h and what is drawn from B_h lie, in a t-SNE map of (state, goal) that
    is common to a row; and the density of what is drawn. data: the arrays of each priority."""
    from scipy.stats import gaussian_kde  # of requirements-experiments.txt
    from sklearn.manifold import TSNE

    fig = Figure(figsize=(12.8, 3.3 * len(STAGES)), layout="constrained")
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
            points.set_title(f"epoch {epoch}, {what}", fontsize=9)
            x, y = np.meshgrid(
                *(np.linspace(*np.quantile(mapped[:, k], [0, 1]), 60) for k in (0, 1))
            )
            shade = gaussian_kde(drawn.T)(np.stack([x.ravel(), y.ravel()])).reshape(x.shape)
            density.pcolormesh(x, y, shade, cmap="viridis")
            density.set_title(
                f"density of what is drawn\n(effective sample size {effective:.1%} of B_h)",
                fontsize=8,
            )
            for ax in (points, density):
                ax.set(xticks=[], yticks=[])
    panels[0, 0].legend(fontsize=7, markerscale=4)
    fig.suptitle(
        "Figure 5: data reuse on PointMassEmptyEnv-v1, half originals, B_o of 10,000, one seed;"
        " 5 updates of batch 64 a cycle",
        fontsize=9,
    )
    return fig


def figure_8(data: dict[int, dict[str, np.ndarray]]) -> Figure:
    """Figure 8: histograms of the variance in B_h for ensembles of K heads, and how often the
    priority draws an original transition (Section 5.8). data: arrays by K."""
    fig = Figure(figsize=(5.2, 1.5 * len(data) + 0.6), layout="constrained")
    panels = fig.subplots(len(data), 1, sharex=True, squeeze=False)[:, 0]
    positive = np.concatenate([d["variance"] for d in data.values()])
    low, high = np.quantile(positive[positive > 0], [0.001, 1])
    bins = np.geomspace(low, high, 60)
    for ax, (k, d) in zip(panels, sorted(data.items()), strict=True):
        for kind, colour in ((True, BLUE), (False, RED)):
            variance = d["variance"][d["hindsight"] == kind]
            name = "hindsight" if kind else "original"
            ax.hist(variance, bins, color=colour, alpha=0.6, density=False, label=name)
            ax.axvline(np.median(variance), color=colour, linestyle="--", linewidth=1)
        original = ~d["hindsight"]
        share, drawn = original.mean(), d["probability"][original].sum()
        ax.set(xscale="log", ylabel=f"K = {k}")
        ax.set_title(f"originals: {share:.1%} of B_h, {drawn:.1%} of the draws", fontsize=7)
    panels[0].legend(fontsize=7)
    panels[-1].set_xlabel("variance of the K Q-values in B_h (dashed: medians)")
    fig.suptitle(
        "Figure 8: PointMassEmptyEnv-v1, half originals,\n"
        "5 updates of batch 64 a cycle, epoch 10, one seed",
        fontsize=9,
    )
    return fig
