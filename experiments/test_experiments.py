"""Tests of the sweep, and of the figures and tables, on made-up runs and on those in results/."""

import csv
import importlib.util
import json
import os
import re
import shutil
import signal
import sys
from dataclasses import asdict
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from filelock import FileLock

from ensemble import MultiHeadMLP, linear
from experiments import didactic, figures, inspect_run, sweep
from harness import settings
from harness.assemble import restored
from harness.errors import UsageError
from harness.records import epochs_done
from harness.settings import METHODS, Config
from harness.tasks import PAPER_ENVS
from harness.testing import COLUMNS, HERE, Line, finish, start, wait_for_an_epoch
from run import train
from vcp import value_consistency_priority

SMALL = "epochs=2,cycles=1,updates=1,batch_size=16,eval_episodes=16"
BASELINES = ("her", "herebp", "cher", "dtgsh")


def make_run(folder, epochs=6, level=1.0, of=None, **given):
    """A run's files, in which the success rises by `level` / 5 an epoch to 1 at most. of: all its
    epochs, for a run that was stopped before."""
    device = given.pop("device", "cpu")
    config = asdict(settings.complete(Config(**given, epochs=of or epochs or 1)))
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"config": config | {"device": device}}))
    with open(folder / "progress.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for epoch in range(1, epochs + 1):
            row = dict.fromkeys(COLUMNS, 0.5) | {"epoch": epoch, "variance_original": 0.25}
            row["test_success_rate"] = min(1, level * epoch / 5 + 0.02 * config["seed"])
            table.writerow(row.values())


@pytest.fixture
def results(tmp_path):
    variants = {
        "vcp": {},
        "uniform": {"priority": "uniform"},
        "one": {"acting_head": "one"},
        "four": {"heads": 4, "level": 0.5},
        "half": {"relabel_ratio": 0.5},
        "more": {"method": "her", "heads": 1, "updates": 80},
        **{f"{m}{k}": {"method": m, "heads": k} for m in BASELINES for k in (1, 16)},
    }
    for name, given in variants.items():
        for env in ("FetchReach-v1", "Reacher-v2"):
            for seed in range(2):
                folder = tmp_path / env / name / f"seed{seed}"
                make_run(folder, epochs=6 + seed, env=env, seed=seed, **given)
    make_run(tmp_path / "push", env="FetchPush-v1", method="her", heads=1)  # VCP is not there
    make_run(tmp_path / "small", env="FetchReach-v1", updates=2)
    make_run(tmp_path / "just-begun", epochs=0, env="FetchReach-v1")
    make_run(tmp_path / "stopped", epochs=2, of=6, env="Reacher-v2", heads_at_once=2)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "labels"),
    [
        ("fig2", ["VCP", "HER, 16 times the updates", "HER", "HEREBP", "CHER", "DTGSH"]),
        ("fig4", ["hindsight", "original"]),
        ("fig6", ["VCP", "VCP, uniform priority", "VCP, acting_head one"]),
        ("fig7", ["VCP", "VCP, 4 heads"]),
        ("fig9", ["VCP", *(f"{m.upper()}, 16 heads" for m in BASELINES)]),
    ],
)
def test_each_figure_has_its_runs(name, labels, results, monkeypatch):
    drawn, curves = {}, figures.curves
    monkeypatch.setattr(figures, "curves", lambda *a: drawn.update(a[0]) or curves(*a))
    assert figures.draw(name, results).read_bytes()[:4] == b"\x89PNG"
    # where VCP is compared with something; of Figure 4 where VCP is
    small = "FetchReach-v1\n5 cycles of 2 updates of batch 64"
    assert {*drawn} == {"FetchReach-v1", "Reacher-v2"} | ({small} if name == "fig4" else set())
    lines = drawn["Reacher-v2"]
    assert sorted(lines) == sorted(labels)
    assert all([len(seed) for seed in seeds] == [6, 7] for seeds in lines.values())
    assert lines[labels[0]][0][0] == (0.5 if name == "fig4" else 0.2)


def test_the_curves():
    """The mean as far as all have come, each seed's line for few and an interval for many."""
    few = [np.array([0.25, 0.5, 0.75]), np.array([0.75, 1.0])]
    fig = figures.curves({"a": {"VCP": few}, "b": {"HER": [np.array([0.5])] * 5}}, "title")
    a, b = fig.axes
    assert [list(line.get_ydata()) for line in a.get_lines()] == [[0.5, 0.75], *map(list, few)]
    assert len(b.get_lines()) == 1 and len(b.collections) == 1 and not a.collections
    assert b.get_lines()[0].get_marker() == "o"  # of one epoch there is no line to be seen
    assert [ax.get_title() for ax in fig.axes] == ["a\n2 runs", "b\n5 runs"]
    assert [text.get_text() for text in fig.legends[0].get_texts()] == ["VCP", "HER"]


def test_ones_own_runs_are_drawn(tmp_path, monkeypatch, capsys):
    make_run(tmp_path / "mine", epochs=1, env="FetchReach-v1", updates=2)
    (tmp_path / "another").mkdir()  # another program's run
    (tmp_path / "another" / "progress.csv").write_text("steps,loss\n1,2\n")
    monkeypatch.setattr(sys, "argv", ["figures", "all", "--runs", str(tmp_path)])
    figures.main()
    out, err = capsys.readouterr()
    assert out.split() == [str(tmp_path / name) for name in ("fig2.png", "fig4.png", "README.md")]
    assert (tmp_path / "FetchReach-v1" / "curves.png").exists()
    for name in ("fig3.npz is missing", "fig5", "fig6 compares runs that are not in", "fig9"):
        assert name in err
    (tmp_path / "another" / "config.json").write_text('{"config": {"lr": 1}}')
    for wrong in ("another", "nowhere"):
        monkeypatch.setattr(sys, "argv", ["figures", "all", "--runs", str(tmp_path / wrong)])
        with pytest.raises(SystemExit):
            figures.main()
        err = capsys.readouterr().err
        assert err.count("error: ") == 1 and str(tmp_path / wrong) in err


def test_the_label_names_what_is_not_the_default():
    for given, label in (
        ({"her_buffer_capacity": 1280}, "VCP, her_buffer_capacity 1280"),
        ({"action_penalty": 0.1, "noise": 0.1}, "VCP, noise 0.1, action_penalty 0.1"),
        ({"env": "FetchPush-v1"}, "VCP"),
        ({"env": "FetchPush-v1", "heads_at_once": 1}, "VCP, heads_at_once 1"),
    ):
        assert figures.label(settings.complete(Config(**given))) == label


def rows_of(path):
    return [line.split(" | ") for line in path.read_text().splitlines() if line.startswith("| ")]


def test_the_summary(results):
    (results / "README.md").write_text(f"above\n\n{figures.BEGIN}\nold\n{figures.END}\n\nbelow\n")
    text = figures.draw("summary", results).read_text()
    assert text.startswith("above\n\n") and text.endswith("\n\nbelow\n") and "old" not in text
    assert "| [FetchPush-v1](FetchPush-v1/README.md) | 6 |  |  |  | 0.67 (1) |\n" in text
    assert "of 2 updates of batch 64 | 6 | 0.67 (1) |  |  |  |\n" in text
    vcp, longer = [r for r in rows_of(results / "Reacher-v2" / "README.md") if r[0] == "| VCP"]
    # success .2 .4 .6 .8 1 1 and .22 .42 .62 .82 1 1 1: six epochs that both have, seven of one
    assert vcp[1:] == ["0,1", "0.21 0.41 1.00 1.00", "0.673 (0.667 0.680)", " |"]
    assert longer[1:] == ["1", "0.22 0.42 1.00 1.00", "0.726", " |"]
    # .1 .2 .3 .4 .5 .6, and .02 more: .35 and .37 in the mean
    four, _ = [r for r in rows_of(results / "Reacher-v2" / "README.md") if "4 heads" in r[0]]
    assert four[3:] == ["0.360 (0.350 0.370)", "+0.313 (+0.317 +0.310) |"]
    (push,) = [r for r in rows_of(results / "FetchPush-v1" / "README.md") if "HER" in r[0]]
    assert push[3:] == ["0.667", " |"]
    assert "heads_at_once" not in (results / "Reacher-v2" / "README.md").read_text()  # stopped


def test_what_the_priority_is_worth(tmp_path):
    """A point is the difference of a seed's two runs over the epochs that both have."""
    for priority, level, epochs in (
        ("consistency", 0.5, 6),
        ("uniform", 0.4, 7),
        ("within-kind", 0.3, 6),
    ):
        for seed in range(2):
            given = {"env": "FetchReach-v1", "seed": seed, "priority": priority}
            make_run(tmp_path / priority / str(seed), epochs, level, **given)
    make_run(tmp_path / "alone", env="Reacher-v2")
    ax = figures.priority_figure(figures.read_runs(tmp_path)).axes[0]
    points = [line.get_xdata() for line in ax.lines if line.get_marker() in ("o", "s")]
    np.testing.assert_allclose(points, [[0.07, 0.07], [-0.07, -0.07]])
    assert [text.get_text() for text in ax.get_yticklabels()] == ["FetchReach-v1"]


def test_readmes_figure_has_four_methods_on_three_tasks(tmp_path):
    methods = ({}, {"priority": "uniform"}, {"method": "her"}, {"method": "her", "heads": 1})
    tasks = ["FetchReach-v1", "FetchPush-v1", "HandReach-v0"]
    for env in [*tasks, "Reacher-v2"]:
        for i, given in enumerate(methods):
            make_run(tmp_path / env / str(i), env=env, **given)
    fig = figures.overview(figures.read_runs(tmp_path))
    assert [ax.get_title() for ax in fig.axes] == [f"{env}\n1 run" for env in tasks]
    assert len(fig.legends[0].get_texts()) == 4 and {len(ax.lines) for ax in fig.axes} == {4}
    shutil.rmtree(tmp_path / "FetchPush-v1" / "3")
    with pytest.raises(SystemExit, match="overview compares runs that are not in"):
        figures.draw("overview", tmp_path)


def test_every_table_in_results_is_generated():
    """And is that of the runs that are there: make it again and compare."""
    tables = figures.tables(figures.by_task(figures.read_runs(figures.RESULTS)))
    files = figures.RESULTS.rglob("README.md")
    assert {str(file.relative_to(figures.RESULTS)) for file in files} == {*tables}
    for name, lines in tables.items():
        before, generated = (figures.RESULTS / name).read_text().split(figures.BEGIN)
        generated, after = generated.split(figures.END)
        assert generated.strip() == "\n".join(lines).strip(), f"{name}: figures summary"
        assert not re.search(r"^\|", before + after, re.M), f"{name} has a table that is typed"


@pytest.mark.parametrize(("highest", "top"), [(0.1, 0.103), (0.11, 1.03), (1, 1.03)])
def test_little_success_is_seen_in_a_panel_of_its_own(highest, top):
    lines = {"VCP": [np.array([0, highest])]}
    fig = figures.curves({"low": lines, "whole": {"VCP": [np.ones(2)]}}, "")
    low, whole = fig.axes
    assert ("axis ends at 0.1" in fig.get_suptitle()) == (top < 1)
    assert low.get_ylim()[1] == pytest.approx(top) and whole.get_ylim()[1] == pytest.approx(1.03)


@pytest.mark.parametrize("env", PAPER_ENVS)
def test_environments_md_says_how_far_each_task_was_learned(env):
    """Success after the last epoch, averaged over the longest runs in results/."""
    text = (HERE / "docs" / "environments.md").read_text()
    row = re.findall(rf"^\| {env} .*", text, re.M)[-1]
    schedule = "_updates-5_batch_size-64" if env.startswith("PointMass") else ""
    for column, name in ((4, f"vcp{schedule}"), (5, f"her{schedule}_heads-1")):
        files = [*figures.RESULTS.glob(f"{env}/{name}/*/progress.csv")]
        files += figures.RESULTS.glob(f"{env}/gpu_{name}/*/progress.csv")
        ends = [list(csv.DictReader(file.open()))[-1] for file in files]
        most = max(int(end["epoch"]) for end in ends)
        last = [float(end["test_success_rate"]) for end in ends if int(end["epoch"]) == most]
        cell = row.split("|")[column].strip()
        assert cell == f"{np.mean(last):.2f} after {most} ({len(last)})", row


def test_runs_are_compared_by_seed_and_machine(tmp_path):
    """A pair is of one seed: on the same kind of machine and, where there is none, on different."""
    ours = [("vcp", 0, "cpu"), ("vcp", 0, "cuda"), ("vcp", 1, "cuda"), ("vcp", 2, "cpu")]
    theirs = [("her", 0, "cuda"), ("her", 1, "cpu"), ("her", 3, "cpu")]
    for i, (method, seed, device) in enumerate([*ours, *theirs]):
        make_run(tmp_path / str(i), env="Reacher-v2", method=method, seed=seed, device=device)
    runs = figures.read_runs(tmp_path)
    ours, theirs = ([r for r in runs if r.config.method == method] for method in ("vcp", "her"))
    assert [(r.config.seed, r.gpu) for r in ours] == [(0, False), (2, False), (0, True), (1, True)]
    pairs = [(a.config.seed, a.gpu, b.config.seed, b.gpu) for a, b in figures.pairs(ours, theirs)]
    assert pairs == [(0, True, 0, True), (1, True, 1, False)]
    figures.draw("summary", tmp_path)
    assert rows_of(tmp_path / "Reacher-v2" / "README.md")[1][1] == "0,2,g0,g1"


def test_statistics_by_hand():
    # 0.1, 0.2 ... 0.5: mean 0.3, standard deviation 0.1581, standard error 0.0707
    low, high = figures.interval(np.arange(1, 6) / 10)
    np.testing.assert_allclose([low, high], [0.3 - 2.776 * 0.070711, 0.3 + 2.776 * 0.070711], 1e-5)
    assert figures.said(np.arange(1, 6) / 10) == "0.300 ±0.196"
    assert figures.said(np.arange(1, 6) / -10, "+") == "-0.300 ±0.196"
    assert figures.interval(np.ones((4, 2))) is None  # too few: the seeds themselves
    assert figures.said(np.array([0.2496, -0.0004]), "+") == "+0.125 (+0.250 +0.000)"  # rounded
    assert figures.said(np.array([0.9996])) == "1.000"
    low, high = figures.interval(np.arange(12.0))  # standard error 1.0408
    np.testing.assert_allclose([low, high], [5.5 - 2.262 * 1.0408, 5.5 + 2.262 * 1.0408], 1e-4)


def test_the_figures_of_variances(tmp_path, monkeypatch, capsys):
    """From the runs that they are of, but tiny, to the pictures."""
    tiny = {"epochs": 1, "cycles": 1, "updates": 1, "batch_size": 64, "eval_episodes": 16}
    monkeypatch.setattr(didactic, "SCHEDULE", {**tiny, "env": "PointMassEmptyEnv-v1"})
    for name, value in {"EPOCH": 1, "SIZES": (2, 4), "SHOWN": 40, "STAGES": (1, 2)}.items():
        monkeypatch.setattr(didactic, name, value)
    monkeypatch.setattr(didactic, "RESULTS", tmp_path)
    monkeypatch.setattr(sys, "argv", ["didactic", "--out", str(tmp_path / "runs")])
    didactic.main()
    with pytest.raises(SystemExit):  # epoch 1 is gone: no figure of epoch 2 in its place
        didactic.main()
    assert "has 2 epochs, not 1" in capsys.readouterr().err
    data = dict(np.load(tmp_path / "didactic" / "fig3.npz"))
    assert data["xy"].shape == (5, 51, 2) and data["variance"].shape == (5, 51)
    assert (data["variance"] > 0).all() and data["value"].shape == (5, 51)
    assert len(data["her_variance"]) == len(data["her_value"]) > 1000
    data = dict(np.load(tmp_path / "didactic" / "fig5_variance.npz"))
    assert {data[f"{kind}_2"].shape for kind in ("original", "her", "drawn")} == {(40, 4)}
    data = dict(np.load(tmp_path / "didactic" / "fig8_4.npz"))
    assert 0.35 < data["hindsight"].mean() < 0.65  # half originals
    np.testing.assert_allclose(data["probability"].sum(), 1, rtol=1e-5)
    for name in ("fig3", "fig8"):
        assert figures.draw(name, tmp_path).read_bytes()[:4] == b"\x89PNG"
    if importlib.util.find_spec("sklearn"):
        assert figures.draw("fig5", tmp_path).read_bytes()[:4] == b"\x89PNG"
    for module in ("scipy.stats", "sklearn.manifold"):
        monkeypatch.setitem(sys.modules, module, None)  # importing it fails
    with pytest.raises(SystemExit, match=r"fig5.*pip install"):
        figures.draw("fig5", tmp_path)


def test_the_correlation_with_the_distance():
    xy = np.stack([np.linspace(0, 1, 9) ** 2, np.zeros(9)], axis=1)[None].repeat(2, axis=0)
    distance = np.linalg.norm(xy - xy[:, [3]], axis=-1)
    variance = np.stack([distance[0] ** 3, -distance[1]])
    r = didactic.distance_correlation({"xy": xy, "t": [3, 3], "variance": variance})
    np.testing.assert_allclose(r, [1, -1])


def test_figure_8_says_how_often_originals_are_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(didactic, "SIZES", (2,))
    hindsight, p = np.array([True, True, True, False]), np.array([0.1, 0.2, 0.3, 0.4])
    arrays = {"variance": np.array([1.0, 2, 3, 4]), "probability": p, "hindsight": hindsight}
    np.savez(tmp_path / "fig8_2.npz", **arrays)
    fig = didactic.draw_figure_8(tmp_path)
    assert fig.axes[0].get_title() == "originals: 25.0% of B_h, 40.0% of the draws"


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("small") / "run"
    train(Config(**sweep.settings(SMALL), env="PointMassEmptyEnv-v1", out=str(folder)))
    return folder


def printed(what, folder, capsys):
    """The cells of the table that inspect_run prints, without the run's name and the epoch."""
    inspect_run.main([what, str(folder)])
    _, epoch, *cells = capsys.readouterr().out.splitlines()[-1].strip(" |").split(" | ")
    assert epoch == "2"
    return cells


def test_the_effective_sample_size(small_run, capsys):
    assert inspect_run.effective_share(value_consistency_priority(np.full(50, 3.0), 9)) == (
        pytest.approx(1)
    )
    # σ² = 0 and 1 with 𝒯 = 1: p = 1 and ε / (1 + ε), so one of two is always drawn
    one = value_consistency_priority(np.array([0.0, 1.0]), 1)
    assert inspect_run.effective_share(one) == pytest.approx(0.5, abs=1e-5)
    sizes = [float(cell.split("%; ")[0]) for cell in printed("effective", small_run, capsys)]
    assert len(sizes) == 5 and sizes == sorted(sizes, reverse=True)


def test_the_share_of_originals_by_temperature():
    """V = 0, 0.5 and 1: originals have half of hindsight's consistency, one transition none."""
    hindsight = np.arange(101) % 5 > 0  # 20 originals, 80 others, and the one with V = 1
    variance = np.append(np.where(hindsight[:100], 0.0, 0.5), 1.0)
    data = {"variance": variance, "hindsight": np.append(hindsight[:100], True)}
    beyond = {name: np.append(x, x[:7]) for name, x in data.items()}  # what B_h does not hold yet
    parts = SimpleNamespace(her_buffer=SimpleNamespace(size=101, data=beyond))
    cells = [cell.split("; ") for cell in inspect_run.effective(parts)]
    # 20 · 0.5^𝒯 / (20 · 0.5^𝒯 + 80)
    assert [cell[2] for cell in cells] == ["11.1%", "0.8%", "0.0%", "0.0%", "0.0%"]
    assert {cell[1] for cell in cells} == {"98.8%"}  # 80 of 81, all alike


def test_which_hindsight_has_goals_like_the_tested_ones(small_run, tmp_path, capsys):
    """A tenth, that on which the critics disagree most, lies where all tested goals do: among 2,000
    goals of each kind there are 200 others. The goals of originals do not count."""
    rng, n = np.random.default_rng(0), 8000
    hindsight = rng.permutation(2 * n) < n
    variance = rng.random(2 * n)
    far = hindsight & (variance > np.quantile(variance[hindsight], 0.9))
    goal = rng.normal(size=(2 * n, 3)) + 9.0 * far[:, None]
    b_h = {"goal": goal, "hindsight": hindsight, "variance": variance}
    parts = SimpleNamespace(
        her_buffer=SimpleNamespace(size=2 * n, data=b_h),
        original_buffer=SimpleNamespace(episodes={"desired_goal": rng.normal(9, 1, (n, 3))}),
    )
    shares = [float(x.rstrip("%")) for x in inspect_run.goals(parts)]
    np.testing.assert_allclose(shares, [0, 0, 91, 91], atol=8)
    still = np.zeros((2 * n, 1))  # a number that is the same in all goals
    b_h["goal"] = np.hstack([goal, still])
    parts.original_buffer.episodes["desired_goal"] = np.hstack(
        [rng.normal(9, 1, (n, 3)), still[:n]]
    )
    shares = [float(x.rstrip("%")) for x in inspect_run.goals(parts)]
    np.testing.assert_allclose(shares, [0, 0, 91, 91], atol=8)
    assert len(printed("goals", small_run, capsys)) == 4
    with pytest.raises(SystemExit):
        make_run(tmp_path / "begun", epochs=0)
        inspect_run.main(["goals", str(tmp_path / "begun")])
    assert "no whole epoch" in capsys.readouterr().err


def test_dead_units(small_run, capsys):
    net = MultiHeadMLP(3, 2, 2, torch.Generator().manual_seed(0), squash=torch.tanh)
    net.stacks[1][0, :64] = -1e6  # a quarter of one of two heads
    net.trunk[3][:32] = -1e6
    x = torch.randn(50, 3)
    embedding, units = inspect_run.hidden(net, x)
    assert embedding.shape == (1, 50, 256) and units.shape == (2, 50, 256)
    assert (embedding[..., :32] == 0).all() and (units[0, :, :64] == 0).all()
    torch.testing.assert_close(torch.tanh(linear(units, *net.stacks[2:])), net.all_heads(x))
    units = torch.zeros(2, 5, 4)
    units[0, 3, 1] = units[1, :, 2] = 0.1  # alive: one of four in each head
    assert inspect_run.dead_share(units) == 0.75
    assert all(0 <= int(cell.rstrip("%")) <= 100 for cell in printed("dead", small_run, capsys))


@pytest.mark.slow
def test_the_trunk_outlives_the_first_cycle(tmp_path):
    """With an Adam for each head, and so K moments of the trunk, four fifths of the actors'
    trunk are dead after 40 updates (NOTES.md, "the trunks' Adam")."""
    short = {"epochs": 1, "cycles": 1, "batch_size": 64, "eval_episodes": 16, "num_workers": 1}
    train(Config(env="FetchPush-v1", heads_at_once=1, **short, out=str(tmp_path)))
    assert int(inspect_run.dead(restored(tmp_path)[0])[0].rstrip("%")) < 30


def asked_for(*arguments):
    """What a sweep of these arguments trains."""
    which = sweep.WHICH.parse_args(arguments)
    return sweep.all_runs(which, SimpleNamespace(cores=1, out="runs"))


def test_what_a_sweep_consists_of():
    variants = ["", "method=her,heads=1", "relabel_ratio=0.5"]
    runs = asked_for(
        *("--env", "FetchReach-v1", "--seeds", "0-1,7", "--set", "epochs=20"),
        *("--variants", *variants),
    )
    assert [c.seed for c in runs] == 3 * [0] + 3 * [1] + 3 * [7]
    assert [c.out for c in runs[:3]] == [
        f"runs/FetchReach-v1/{name}/seed0"
        for name in ("vcp", "her_heads-1", "vcp_relabel_ratio-0.5")
    ]
    assert (runs[1].method, runs[1].heads, runs[1].epochs) == ("her", 1, 20)
    assert sweep.settings("heads=2,temperature=5") == {"heads": 2, "temperature": 5.0}
    (config,) = asked_for("--env", "FetchReach-v1", "--set", "threads=3")
    assert (config.threads, config.num_workers) == (3, 1)


@pytest.mark.parametrize("wrong", ["--seeds many", "--seeds 5-1", "--variants colour=red"])
def test_a_sweep_of_what_cannot_be_run_is_refused(wrong, capsys, monkeypatch):
    with pytest.raises(SystemExit) as stop:
        sweep.main(["--env", "PointMassEmptyEnv-v1", "--list", *wrong.split()])
    assert stop.value.code == 2 and re.search("error: .*(--seeds|colour)", capsys.readouterr().err)
    with pytest.raises(UsageError, match="two runs are the same"):
        asked_for("--env", "FetchReach-v1", "--variants", "", "heads=16")
    monkeypatch.setitem(sys.modules, "ray", None)  # importing it fails
    with pytest.raises(SystemExit, match=r"Ray is missing: pip install"):
        sweep.main(["--env", "PointMassEmptyEnv-v1", "--set", SMALL])


def test_environments_are_checked_with_the_settings_of_the_runs(capsys):
    gym.register("Lengthless-v0", Line)
    listed = ["--env", "Lengthless-v0", "--list", "--variants"]
    sweep.main([*listed, "episode_length=7"])
    with pytest.raises(SystemExit):
        sweep.main([*listed, ""])
    assert "no episode length" in capsys.readouterr().err


@pytest.fixture
def plan(tmp_path):
    """The arguments of a sweep of a plan of three runs, the last the first's with more epochs; and
    the folders of the two."""
    (tmp_path / "plan.txt").write_text(f"""
# the runs below are few
--env PointMassEmptyEnv-v1 --variants "" priority=uniform --set {SMALL}
--env PointMassEmptyEnv-v1 --set {SMALL.replace("epochs=2", "epochs=3")}
""")
    arguments = ["--plan", str(tmp_path / "plan.txt"), "--out", str(tmp_path / "runs")]
    return arguments, folder_of(tmp_path / "runs"), folder_of(tmp_path / "runs", priority="uniform")


def folder_of(root, seed=0, **settings_of):
    """Where a sweep over SMALL has its run."""
    given = {**sweep.settings(SMALL), "env": "PointMassEmptyEnv-v1", "seed": seed, **settings_of}
    return root / settings.default_folder(settings.complete(Config(**given)))


def swept(arguments, capsys):
    """The exit code and what is printed."""
    with pytest.raises(SystemExit) as stop:
        sweep.main(arguments)
    return stop.value.code, capsys.readouterr().out


def test_a_plan_is_done_in_its_order_and_gone_on_with(plan, capsys):
    arguments, first, second = plan
    second.mkdir(parents=True)
    with FileLock(second / ".lock"):  # another process has it
        code, text = swept(arguments, capsys)
    assert code == 0 and text.splitlines()[-1] == "2 of 3 runs are whole"
    assert f"another process trains in {second}" in text and not (second / "error.txt").exists()
    assert epochs_done(first) == 3
    order = [f"now {first}, 0 of 2", f"now {second}, 0 of 2", f"now {first}, 2 of 3"]
    assert [text.index(line) for line in order] == sorted(text.index(line) for line in order)
    before = (first / "progress.csv").read_bytes()
    _, text = swept(arguments, capsys)
    assert f"now {first}" not in text and text.splitlines()[-1] == "3 of 3 runs are whole"
    assert (first / "progress.csv").read_bytes() == before
    sweep.main([*arguments, "--list"])
    assert [line.split()[1] for line in capsys.readouterr().out.splitlines()] == ["3", "2", "3"]


def test_a_run_that_fails_or_is_anothers_does_not_stop_the_others(plan, capsys, monkeypatch):
    """One says why it failed, in its folder. Of many processes that start at once one is the first
    in a folder, and the others leave it to that one."""
    arguments, first, broken = plan

    def badly(config, resume):
        if config.priority == "uniform":
            raise FloatingPointError("NaN or Inf in the test")
        if config.out == str(first) and not resume:
            train(config, resume)  # the other process's
        return train(config, resume)

    monkeypatch.setattr(sweep.run, "train", badly)
    code, text = swept(arguments, capsys)
    assert code == 1 and f"FAILED {broken}: FloatingPointError" in text
    error = (broken / "error.txt").read_text()
    assert "Traceback" in error and "NaN or Inf in the test" in error
    assert "another process was the first in" in text and not (first / "error.txt").exists()
    assert epochs_done(first) == 3
    monkeypatch.setattr(sweep.run, "train", train)
    assert swept(arguments, capsys)[0] == 0 and not (broken / "error.txt").exists()


@pytest.mark.parametrize("option", ["--seeds 1", "--set heads=2", "--variants x", "--gpus 1"])
def test_a_plan_says_by_itself_what_is_run(option, plan, capsys):
    with pytest.raises(SystemExit) as stop:
        sweep.main([*plan[0], "--list", *option.split()])
    err = capsys.readouterr().err
    assert stop.value.code == 2 and f"{option.split()[0]} does not go with --plan" in err


def test_an_environment_that_changes_the_folder_does_not_move_the_runs(
    tmp_path, monkeypatch, capsys
):
    class Moves(Line):
        def __init__(self, render_mode=None):
            os.chdir("/")

    gym.register("Moves-v0", Moves, max_episode_steps=10)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plan.txt").write_text(f'--env Moves-v0 --variants "" heads=2 --set {SMALL}')
    code, out = swept(["--plan", "plan.txt"], capsys)
    assert code == 0 and out.endswith("2 of 2 runs are whole\n")
    assert len([*tmp_path.glob("runs/Moves-v0/*/seed0/checkpoint.pt")]) == 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_plan_that_is_told_to_stop_loses_no_whole_epoch(name, tmp_path):
    plan, out = tmp_path / "plan.txt", tmp_path / "runs"
    longer = SMALL.replace("epochs=2", "epochs=100000")
    plan.write_text(f"--env PointMassEmptyEnv-v1 --set {longer}")
    process = start("--plan", plan, "--out", out, module="experiments.sweep")
    folder = folder_of(out)
    wait_for_an_epoch(process, folder)
    process.send_signal(getattr(signal, name))
    code, text, err = finish(process)
    assert code == 1 and err == "sweep.py: stopped; the same command goes on\n"
    assert f"now {folder}, 0 of 100000 epochs" in text and not (folder / "error.txt").exists()
    done = epochs_done(folder)
    plan.write_text(f"--env PointMassEmptyEnv-v1 --set {SMALL.replace('=2', f'={done + 1}', 1)}")
    code, text, err = finish(start("--plan", plan, "--out", out, module="experiments.sweep"))
    assert code == 0 and f"now {folder}, {done} of {done + 1} epochs" in text, err
    assert epochs_done(folder) == done + 1


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_sweep_that_is_told_to_stop_while_it_imports_ends_with_its_line(name, tmp_path):
    (tmp_path / "slow.py").write_text("exec('import time; print(1, flush=True); time.sleep(600)')")
    process = start("--env", "slow:Slow-v0", module="experiments.sweep", cwd=tmp_path)
    assert process.stdout.readline() == "1\n"
    process.send_signal(getattr(signal, name))
    code, _, err = finish(process)
    assert code == 1 and err == "sweep.py: stopped; the same command goes on\n"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--env PointMassEmptyEnv-v1 --variants heads=0", "line 2: --heads must be"),
        ("--env PointMassEmptyEnv-v1 --set heads=many", "line 2: heads=many: not of type int"),
        ("--env PointMassEmptyEnv-v1 --set method=sac", "line 2: --method must be one of"),
        ("--env PointMassEmptyEnv-v1 --set temperature=hot", "line 2: temperature=hot: not of"),
        ("--env PointMassEmptyEnv-v1 --variants seed=1", "line 2: seed is no setting"),
        ("--env PointMassEmptyEnv-v1 --colour red", "line 2: unknown: --colour red"),
        ("--seeds 0-2", "line 2: no --env"),
        ('--env "PointMass', "line 2: No closing quotation"),
        ("--env PointMassEmptyEnv-v1 --seeds many", "line 2: argument --seeds"),
        ("--env Nowhere-v0", "cannot learn in the environment Nowhere-v0"),
    ],
)
def test_a_plan_of_what_cannot_be_run_is_refused(line, message, tmp_path, capsys):
    plan = tmp_path / "plan.txt"
    plan.write_text(f"# nothing\n{line}\n")
    with pytest.raises(SystemExit) as stop:
        sweep.main(["--plan", str(plan), "--out", str(tmp_path / "runs")])
    assert stop.value.code == 2 and message in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "runs").exists()


def test_the_papers_plan_is_its_whole_comparison():
    given = SimpleNamespace(cores=1, out="runs")
    runs = sweep.planned(sweep.ROOT / "experiments" / "paper.txt", given)
    last = {(c.env, settings.variant(c), c.seed): c.epochs for c in runs}
    assert {env for env, _, _ in last} == set(PAPER_ENVS)
    ablations = ["vcp_priority-uniform", "vcp_priority-variance", "vcp_acting_head-one"]
    for env in PAPER_ENVS:
        for name in (*METHODS, *(f"{method}_heads-1" for method in BASELINES), *ablations):
            assert last[env, name, 9] == 50
    assert runs[0].env == "FetchPush-v1" and runs[0].epochs == 20


@pytest.mark.slow
def test_a_sweep_in_ray(tmp_path, capsys):
    pytest.importorskip("ray", reason="requirements-experiments.txt is not installed")
    broken = folder_of(tmp_path, seed=1, priority="uniform")
    make_run(broken, epochs=1, env="PointMassEmptyEnv-v1", seed=1)  # with other settings
    variants = ["--variants", "", "priority=uniform", "--set", SMALL, "--seeds", "0-1"]
    arguments = ["--env", "PointMassEmptyEnv-v1", *variants, "--out", str(tmp_path)]
    code, text = swept(arguments, capsys)
    assert code == 1 and "3 of 4 runs are whole" in text
    assert f"FAILED {broken}: " in text and "was made with" in text
    assert epochs_done(folder_of(tmp_path, seed=1)) == 2
