"""Tests of the figures, on made-up runs, and of the sweep."""

import csv
import importlib.util
import json
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
from harness.records import COLUMNS, as_tensors, epochs_done, read_checkpoint
from harness.settings import METHODS, Config
from harness.tasks import PAPER_ENVS, examine
from harness.testing import Line, finish, start, wait_for_an_epoch, without_timing
from her import EpisodeBuffer
from run import train
from vcp import value_consistency_priority

SMALL = "epochs=2,cycles=1,updates=1,batch_size=16,eval_episodes=16"


def make_run(folder, epochs=6, level=1.0, of=None, **given):
    """A run's files, in which the success rises by `level` to 1 at most. of: all its epochs, for a
    run that was stopped before."""
    config = settings.complete(Config(**given, epochs=of or epochs or 1))
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps({"config": asdict(config)}))
    with open(folder / "progress.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)
        for epoch in range(1, epochs + 1):
            row = dict.fromkeys(COLUMNS, 0.5) | {"epoch": epoch, "wall_seconds": 90 * epoch}
            row["test_success_rate"] = min(1, level * epoch / 5 + 0.01 * config.seed)
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
        "other": {"temperature": 1.0},
        **{f"{m}{k}": {"method": m, "heads": k} for m in figures.BASELINES for k in (1, 16)},
    }
    for name, given in variants.items():
        for env in ("FetchReach-v1", "Reacher-v2"):
            for seed in range(2):
                folder = tmp_path / env / name / f"seed{seed}"
                make_run(folder, epochs=6 + seed, env=env, seed=seed, **given)
    for method in ("her", "cher"):  # nothing to compare VCP with
        make_run(tmp_path / "push" / method, env="FetchPush-v1", method=method, heads=1)
    make_run(tmp_path / "small", env="FetchReach-v1", updates=2)
    make_run(tmp_path / "just-begun", epochs=0, env="FetchReach-v1")
    make_run(tmp_path / "stopped", epochs=2, of=6, env="Reacher-v2", heads_at_once=2)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        (
            "fig2",
            [
                "VCP",
                "HER, 16 times the updates",
                *(f"{m.upper()}" for m in figures.BASELINES),
            ],
        ),
        ("fig9", ["VCP", *(f"{m.upper()}, 16 heads" for m in figures.BASELINES)]),
        ("fig6", ["VCP", "VCP, uniform priority", "VCP, one acting head"]),
        ("fig7", ["VCP", "VCP, 4 heads"]),
    ],
)
def test_each_figure_has_its_runs(name, lines, results, monkeypatch):
    drawn = {}

    def keep(*args, **kwargs):
        fig = curves(*args, **kwargs)
        for ax in fig.axes:
            drawn[ax.get_title()] = [line.get_label() for line in ax.get_lines()[::3]]
            for mean, *seeds in zip(*[iter(ax.get_lines())] * 3, strict=True):  # and each seed's
                assert [len(line.get_xdata()) for line in (mean, *seeds)] == [6, 6, 7]
                if mean.get_label() == "VCP":
                    np.testing.assert_allclose(seeds[1].get_ydata()[:2], [0.21, 0.31])
        legend = [text.get_text() for text in fig.legends[0].get_texts()]
        assert set(legend) == {name for names in drawn.values() for name in names}
        return fig

    curves = figures.curves
    monkeypatch.setattr(figures, "curves", keep)
    path = figures.draw(name, results, smooth=0.5)
    assert path.read_bytes()[:4] == b"\x89PNG"
    # another schedule is another panel, drawn where it has something to compare VCP with
    assert sorted(drawn) == ["FetchReach-v1, 2 seeds", "Reacher-v2, 2 seeds"]
    assert all(sorted(drawn[panel]) == sorted(lines) for panel in drawn)


def test_ones_own_runs_are_drawn(tmp_path, monkeypatch, capsys):
    make_run(tmp_path / "mine", epochs=1, env="FetchReach-v1", updates=2)
    monkeypatch.setattr(sys, "argv", ["figures", "all", "--runs", str(tmp_path)])
    drawn, draw_line = [], figures.draw_line
    monkeypatch.setattr(figures, "draw_line", lambda ax, *a: drawn.append(ax) or draw_line(ax, *a))
    figures.main()
    out, err = capsys.readouterr()
    assert out.split() == [str(tmp_path / "fig2.png"), str(tmp_path / "summary.md")]
    for name in ("fig3", "fig4", "fig6", "fig7", "fig9"):
        assert name in err
    (line,) = drawn[0].get_lines()
    assert line.get_marker() == "o"  # of one epoch there is no line to be seen
    assert drawn[0].get_title() == "FetchReach-v1, 1 seed\n5 cycles of 2 updates of batch 64"
    monkeypatch.setattr(sys, "argv", ["figures", "all", "--runs", str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit):
        figures.main()


@pytest.mark.parametrize(
    "given, label",
    [
        ({"temperature": 1.0}, "VCP, temperature 1.0"),
        ({"buffer_size": 10_000}, "VCP, buffer_size 10000"),
        ({"scored_per_drawn": 0.25}, "VCP, scored_per_drawn 0.25"),
        ({"her_buffer_capacity": 1280}, "VCP, her_buffer_capacity 1280"),
        ({"action_penalty": 0.1, "noise": 0.1}, "VCP, noise 0.1, action_penalty 0.1"),
        ({"env": "FetchPush-v1"}, "VCP"),
        ({"env": "FetchPush-v1", "heads_at_once": 1}, "VCP, heads_at_once 1"),
        ({"heads_at_once": 16}, "VCP, heads_at_once 16"),
    ],
)
def test_the_label_names_what_is_not_the_default(given, label):
    assert figures.label(settings.complete(Config(**given))) == label


def test_figure_4(results):
    assert figures.draw("fig4", results).read_bytes()[:4] == b"\x89PNG"


def test_the_figures_of_variances(tmp_path, monkeypatch, capsys):
    """From the runs that they are of, but tiny, to the pictures."""
    tiny = {"epochs": 1, "cycles": 1, "updates": 1, "batch_size": 64, "eval_episodes": 16}
    monkeypatch.setattr(didactic, "SCHEDULE", {**tiny, "env": "PointMassEmptyEnv-v1"})
    monkeypatch.setattr(didactic, "EPOCH", 1)
    monkeypatch.setattr(didactic, "SIZES", (2, 4))
    monkeypatch.setattr(didactic, "SHOWN", 40)
    monkeypatch.setattr(didactic, "STAGES", (1, 2))
    monkeypatch.setattr(didactic, "RESULTS", tmp_path)
    monkeypatch.setattr(sys, "argv", ["didactic", "--out", str(tmp_path / "runs")])
    didactic.main()
    with pytest.raises(SystemExit):  # epoch 1 is gone: no figure of epoch 2 in its place
        didactic.main()
    assert "has 2 epochs, not 1" in capsys.readouterr().err
    data = dict(np.load(tmp_path / "didactic" / "fig3.npz"))
    assert data["xy"].shape == (5, 51, 2) and data["variance"].shape == (5, 51)
    assert (data["variance"] > 0).all()
    data = dict(np.load(tmp_path / "didactic" / "fig5_variance.npz"))
    assert {data[f"{kind}_2"].shape for kind in ("original", "her", "drawn")} == {(40, 4)}
    data = dict(np.load(tmp_path / "didactic" / "fig8_4.npz"))
    assert 0.35 < data["hindsight"].mean() < 0.65  # half originals
    np.testing.assert_allclose(data["probability"].sum(), 1, rtol=1e-5)
    for name in ("fig3", "fig8"):
        assert figures.draw(name, tmp_path).read_bytes()[:4] == b"\x89PNG"
    if importlib.util.find_spec("sklearn"):
        assert figures.draw("fig5", tmp_path).read_bytes()[:4] == b"\x89PNG"


def test_the_correlation_with_the_distance():
    xy = np.stack([np.linspace(0, 1, 9) ** 2, np.zeros(9)], axis=1)[None].repeat(2, axis=0)
    distance = np.linalg.norm(xy - xy[:, [3]], axis=-1)
    variance = np.stack([distance[0] ** 3, -distance[1]])
    r = didactic.distance_correlation({"xy": xy, "t": [3, 3], "variance": variance})
    np.testing.assert_allclose(r, [1, -1])


def test_figure_8_says_how_often_originals_are_drawn():
    hindsight, p = np.array([True, True, True, False]), np.array([0.1, 0.2, 0.3, 0.4])
    variance = np.array([1.0, 2, 3, 4])
    data = {"variance": variance, "probability": p, "hindsight": hindsight}
    fig = didactic.draw_figure_8({2: data})
    assert fig.axes[0].get_title() == "originals: 25.0% of B_h, 40.0% of the draws"


def test_the_effective_sample_size(tmp_path, capsys):
    assert inspect_run.effective_share(value_consistency_priority(np.full(50, 3.0), 9)) == (
        pytest.approx(1)
    )
    # σ² = 0 and 1 with 𝒯 = 1: p = 1 and ε / (1 + ε), so one of two is always drawn
    one = value_consistency_priority(np.array([0.0, 1.0]), 1)
    assert inspect_run.effective_share(one) == pytest.approx(0.5, abs=1e-5)
    sweep.main(arguments(tmp_path, "--task", "0"))
    inspect_run.main(["effective", str(folder_of(tmp_path))])
    line = capsys.readouterr().out.splitlines()[-1].split(" | ")
    shares = [[float(x.rstrip("% |")) for x in cell.split("; ")] for cell in line[2:]]
    sizes, _ = zip(*shares, strict=True)
    assert line[1] == "2" and len(sizes) == 5 and sizes == tuple(sorted(sizes, reverse=True))


def test_the_share_of_originals_by_temperature():
    """V = 0, 0.5 and 1: originals have half of hindsight's consistency, one transition none."""
    hindsight = np.arange(101) % 5 > 0  # 20 originals, 80 others, and the one with V = 1
    variance = np.append(np.where(hindsight[:100], 0.0, 0.5), 1.0)
    data = {"variance": variance, "hindsight": np.append(hindsight[:100], True)}
    beyond = {name: np.append(x, x[:7]) for name, x in data.items()}  # what B_h does not hold yet
    its = SimpleNamespace(her_buffer=SimpleNamespace(size=101, data=beyond))
    cells = [cell.split("; ")[1] for cell in inspect_run.effective(its)]
    # 20 · 0.5^𝒯 / (20 · 0.5^𝒯 + 80)
    assert cells == ["11.1%", "0.8%", "0.0%", "0.0%", "0.0%"]


def test_what_each_method_replays(tmp_path, capsys):
    """Half of the episodes stand still; in the others each step leads out of the threshold, so that
    r = 0 for t' = t + 1 alone, on average over t for H_T / T of the hindsight. Originals are never
    at their goal."""
    horizon = 50
    ahead = 1 - np.sum(1 / np.arange(1, horizon + 1)) / horizon

    def far(obs, action, goal):  # of the variance 1, what is near of 0
        return (np.linalg.norm(obs - goal, axis=1) > 2).astype(float)

    config, agent = Config(env="PointMassEmptyEnv-v1"), SimpleNamespace(q_variance=far)
    task = examine(config.env)
    original = EpisodeBuffer(10_000, horizon, 2, 2, 2, 0.8, task.reward_fn)
    xy = np.zeros((200, horizon + 1, 2))
    xy[100:] = np.arange(horizon + 1)[:, None]
    episodes = {"obs": xy, "achieved_goal": xy, "desired_goal": xy[:, 0] - 1}
    original.add({**episodes, "action": np.zeros((200, horizon, 2))}, np.random.default_rng(0))

    def share(its, method):
        return inspect_run.shares(inspect_run.drawn(its, method, np.random.default_rng(0)))

    its = SimpleNamespace(config=config, task=task, agent=agent, original_buffer=original)
    x = {method: share(its, method) for method in METHODS}
    for method, expected in (("her", ahead / 2), ("herebp", ahead)):
        assert x[method]["originals"] == pytest.approx(0.2, abs=0.02)
        assert x[method]["ahead"] == pytest.approx(0.2 + 0.8 * expected, abs=0.02)
    # nothing far is drawn: originals are as near as (-1, -1), and all their draws are ahead
    assert x["vcp"]["ahead"] == pytest.approx(x["vcp"]["originals"], abs=0.02)
    its.config = Config(env=config.env, heads=1)
    assert inspect_run.replayed(its)[0] == ""

    sweep.main(arguments(tmp_path, "--task", "0"))
    folder = folder_of(tmp_path)
    (whole, _), saved = restored(folder), read_checkpoint(folder / "checkpoint.pt")["parts"]
    for part, state in zip(whole.state(), saved, strict=True):
        torch.testing.assert_close(as_tensors(part.state_dict()), state, rtol=0, atol=0)
    inspect_run.main(["replayed", str(folder)])
    line = capsys.readouterr().out.splitlines()[-1].split(" | ")
    assert line[1] == "2" and len(line) == 2 + len(METHODS)
    with pytest.raises(SystemExit):
        make_run(tmp_path / "begun", epochs=0)
        inspect_run.main(["replayed", str(tmp_path / "begun")])
    assert "no whole epoch" in capsys.readouterr().err


def test_the_shares_by_weight():
    batch = {
        "hindsight": np.array([True, True, False, False]),
        "reward": np.array([-1.0, 0, 0, -1]),
        "weight": np.array([0.5, 0.5, 1, 2]),
    }
    by_hand = {"originals": 0.5, "originals weighted": 0.75, "ahead": 0.5, "ahead weighted": 0.625}
    assert inspect_run.shares(batch) == by_hand


def test_dead_units(tmp_path, capsys):
    net = MultiHeadMLP(3, 2, 2, torch.Generator().manual_seed(0), squash=torch.tanh)
    net.stacks[1][0, :64] = -1e6  # a quarter of one of two heads
    net.trunk[3][:32] = -1e6
    embedding, units = inspect_run.hidden(net, torch.randn(50, 3))
    assert embedding.shape == (1, 50, 256) and units.shape == (2, 50, 256)
    assert (embedding[..., :32] == 0).all() and (units[0, :, :64] == 0).all()
    x = torch.randn(50, 3)
    outputs = torch.tanh(linear(inspect_run.hidden(net, x)[1], *net.stacks[2:]))
    torch.testing.assert_close(outputs, net.all_heads(x))
    units = torch.zeros(2, 5, 4)
    units[0, 3, 1] = units[1, :, 2] = 0.1  # alive: one of four in each head
    assert inspect_run.dead_share(units) == 0.75
    sweep.main(arguments(tmp_path, "--task", "0"))
    inspect_run.main(["dead", str(folder_of(tmp_path))])
    line = capsys.readouterr().out.splitlines()[-1].split(" | ")
    assert line[1] == "2" and all(0 <= int(x.rstrip("% |")) <= 100 for x in line[2:])


@pytest.mark.slow
def test_the_trunk_outlives_the_first_cycle(tmp_path, capsys):
    """With an Adam for each head, and so K moments of the trunk, four fifths of the actors'
    trunk are dead after 40 updates (NOTES.md, "the trunks' Adam")."""
    settings = {
        "env": "FetchPush-v1",
        "epochs": 1,
        "cycles": 1,
        "batch_size": 64,
        "heads_at_once": 1,
    }
    train(Config(**settings, eval_episodes=16, num_workers=1, out=str(tmp_path)))
    inspect_run.main(["dead", str(tmp_path)])
    line = capsys.readouterr().out.splitlines()[-1].split(" | ")
    assert line[1] == "1" and int(line[2].rstrip("%")) < 30


def test_what_is_not_installed_is_said(tmp_path, monkeypatch):
    for module in ("ray", "scipy.stats", "sklearn.manifold"):
        monkeypatch.setitem(sys.modules, module, None)  # importing it fails
    with pytest.raises(SystemExit, match=r"Ray is missing: pip install"):
        sweep.main(arguments(tmp_path))
    arrays = {"fig5_consistency": {}, "fig5_variance": {}}
    (tmp_path / "didactic").mkdir()
    for name, its in arrays.items():
        np.savez(tmp_path / "didactic" / f"{name}.npz", **its)
    with pytest.raises(SystemExit, match=r"fig5.*pip install"):
        figures.draw("fig5", tmp_path)


def test_no_runs_is_said(tmp_path):
    with pytest.raises(SystemExit, match=r"fig3\.npz is missing"):
        figures.draw("fig3", tmp_path)
    with pytest.raises(SystemExit, match="fig2 compares runs that are not in"):
        figures.draw("fig2", tmp_path)


def test_the_summary(results):
    rows = [line.split(" | ") for line in figures.draw("summary", results).read_text().splitlines()]
    vcp, longer = [r for r in rows if r[:2] == ["| Reacher-v2", "VCP"]]
    # success .2 .4 .6 .8 1 1 and .21 .41 .61 .81 1 1 1, six epochs that both have, seven of one
    assert vcp[2:5] == ["2", "6", "5"]
    assert vcp[5] == "0.670 (0.667 0.673)" and vcp[6] == "0.763 (0.760 0.766)"
    assert vcp[7] == "1.50 |"  # minutes an epoch
    assert longer[2:7] == ["1", "7", "5", "0.720", "0.884"]
    (push,) = [r for r in rows if r[:2] == ["| FetchPush-v1", "HER"]]  # where there is no VCP
    assert push[2:4] == ["1", "6"]
    assert not [r for r in rows if "heads_at_once" in str(r)]  # stopped
    # .35 and .36 twice, beside .667 and .673 twice; the schedule that only VCP has does not count
    (total,) = [r for r in rows if r[0] == "| VCP, 4 heads" and len(r) == 4]
    assert total[1] == "FetchReach-v1; Reacher-v2"
    assert total[2] == "0.355" and total[3] == "0.670 |"
    assert not [r for r in rows if r[0] == "| VCP"]


def test_the_summary_gives_each_environment_the_same_weight(tmp_path):
    """One environment at 0 with one seed and one at 1 with three: the middle half is half of each,
    not the 1 of all runs together."""
    for method in ("vcp", "her"):
        make_run(tmp_path / method / "a", level=0, env="FetchReach-v1", method=method)
        for seed in range(3):
            folder = tmp_path / method / f"b{seed}"
            make_run(folder, level=5, env="Reacher-v2", method=method, seed=seed)
    last = figures.draw("summary", tmp_path).read_text().splitlines()[-1]
    assert last.split(" | ")[2:] == ["0.500", "0.500 |"]


def test_smoothing_and_statistics_by_hand():
    x = np.array([[0.0, 1, 1]])
    np.testing.assert_array_equal(figures.smoothed(x, 0), x)
    np.testing.assert_allclose(figures.smoothed(x, 0.9), [[0, 0.1, 0.19]])
    assert figures.interquartile_mean(np.array([9.0, 1, 2, 3, 4, 5, 6, -7])) == 3.5
    # 0.1, 0.2 ... 0.5: mean 0.3, standard deviation 0.1581, standard error 0.0707
    low, high = figures.interval(np.arange(1, 6) / 10)
    np.testing.assert_allclose([low, high], [0.3 - 2.776 * 0.070711, 0.3 + 2.776 * 0.070711], 1e-5)
    assert figures.said(np.arange(1, 6) / 10) == "0.300 (0.104-0.496)"
    assert figures.interval(np.ones((4, 2))) is None  # too few: the seeds themselves
    assert figures.said(np.array([0.25, 0.5])) == "0.375 (0.250 0.500)"
    assert figures.said(np.array([0.25])) == "0.250"
    low, high = figures.interval(np.full((12, 2), 0.7))
    np.testing.assert_allclose([low, high], 0.7)


def test_what_a_sweep_consists_of(tmp_path):
    given = {"epochs": 20, "num_workers": 1}
    variants = ["", "method=her,heads=1", "relabel_ratio=0.5"]
    runs = sweep.all_runs(["FetchReach-v1"], variants, sweep.seeds("0-1,7"), given, tmp_path)
    assert [c.seed for c in runs] == 3 * [0] + 3 * [1] + 3 * [7]
    folders = [c.out.removeprefix(str(tmp_path)) for c in runs[:3]]
    assert folders == [
        f"/FetchReach-v1/{name}/seed0" for name in ("vcp", "her_heads-1", "vcp_relabel_ratio-0.5")
    ]
    assert (runs[1].method, runs[1].heads, runs[1].epochs) == ("her", 1, 20)
    assert sweep.settings("heads=2,temperature=5") == {"heads": 2, "temperature": 5.0}


@pytest.mark.parametrize(
    "wrong",
    [
        "--variants colour=red",
        "--variants heads=many",
        "--variants method=sac",
        "--variants heads=0",
        "--seeds many",
        "--seeds 5-1",
        "--variants seed=1",
        "--variants out=x",
        "--variants env=FetchReach-v1",
        "--task 1",
    ],
)
def test_a_sweep_of_what_cannot_be_run_is_refused(wrong, capsys):
    with pytest.raises(SystemExit) as stop:
        sweep.main(["--env", "PointMassEmptyEnv-v1", "--list", *wrong.split()])
    option, value = wrong.split()
    named = option if option != "--variants" else value.split("=")[0]
    error = capsys.readouterr().err.splitlines()[-1]
    assert stop.value.code == 2 and named in error.split("error:")[1]
    with pytest.raises(UsageError):
        sweep.check_environments([Config(env="Nowhere-v0")])


def folder_of(root, seed=0, **settings_of):
    """Where a sweep over SMALL has its run."""
    given = {**sweep.settings(SMALL), "env": "PointMassEmptyEnv-v1", "seed": seed, **settings_of}
    return root / settings.default_folder(settings.complete(Config(**given)))


def arguments(folder, *others):
    its = ["--env", "PointMassEmptyEnv-v1", "--variants", "", "priority=uniform", "--set", SMALL]
    return [*its, "--out", str(folder), *others]


def test_a_task_of_a_sweep_is_skipped_done_or_gone_on_with(tmp_path, capsys):
    """What a SLURM array does, without Ray."""
    for task in (0, 1):
        sweep.main(arguments(tmp_path / "a", "--task", str(task)))
    whole = folder_of(tmp_path / "a", priority="uniform")
    assert epochs_done(whole) == 2
    stopped = [SMALL.replace("epochs=2", "epochs=1") if x == SMALL else x for x in arguments("b")]
    stopped[stopped.index("b")] = str(tmp_path / "b")
    sweep.main([*stopped, "--task", "1"])
    sweep.main(arguments(tmp_path / "b", "--task", "1"))
    resumed = folder_of(tmp_path / "b", priority="uniform")
    assert without_timing(resumed) == without_timing(whole)
    before = (resumed / "progress.csv").read_bytes()
    sweep.main(arguments(tmp_path / "b", "--task", "1"))
    assert (resumed / "progress.csv").read_bytes() == before
    capsys.readouterr()
    sweep.main(arguments(tmp_path / "b", "--list"))
    assert [line.split()[1] for line in capsys.readouterr().out.splitlines()] == ["0", "2"]


PLAN = f"""
# the runs below are few
--env PointMassEmptyEnv-v1 --variants "" priority=uniform --set {SMALL}
--env PointMassEmptyEnv-v1 --set {SMALL.replace("epochs=2", "epochs=3")}
"""


def test_a_plan_is_done_in_its_order_and_gone_on_with(tmp_path, capsys):
    plan, out = tmp_path / "plan.txt", tmp_path / "runs"
    plan.write_text(PLAN)
    arguments = ["--plan", str(plan), "--out", str(out)]
    first, second = folder_of(out), folder_of(out, priority="uniform")
    second.mkdir(parents=True)
    with FileLock(second / ".lock"), pytest.raises(SystemExit) as stop:  # another process has it
        sweep.main(arguments)
    text = capsys.readouterr().out
    assert stop.value.code == 0 and "2 of 3 runs are whole" in text
    assert f"another process trains in {second}" in text and not (second / "error.txt").exists()
    assert epochs_done(first) == 3
    assert text.index(f"now {first}, 0 of 2") < text.index(f"now {second}, 0 of 2")
    assert text.index(f"now {second}, 0 of 2") < text.index(f"now {first}, 2 of 3")
    assert "2 of 2 runs are left; 2 are of a kind not timed yet" in text
    assert text.count("2 of 2 runs are left; 2 of them need 0.0 core-hours; 0 are") == 2
    with pytest.raises(SystemExit):
        sweep.main(arguments)
    text = capsys.readouterr().out
    assert f"now {first}" not in text and "3 of 3 runs are whole" in text
    sweep.main([*arguments, "--list"])
    assert [line.split()[1] for line in capsys.readouterr().out.splitlines()] == ["3", "2", "3"]


def test_a_run_that_fails_says_why_in_its_folder_and_the_next_is_trained(
    tmp_path, capsys, monkeypatch
):
    plan, out = tmp_path / "plan.txt", tmp_path / "runs"
    plan.write_text(PLAN)
    train = sweep.run.train

    def fails(config, resume):
        if config.priority == "uniform":
            raise FloatingPointError("NaN or Inf in the test")
        return train(config, resume)

    monkeypatch.setattr(sweep.run, "train", fails)
    with pytest.raises(SystemExit) as stop:
        sweep.main(["--plan", str(plan), "--out", str(out)])
    broken = folder_of(out, priority="uniform")
    assert (
        stop.value.code == 1 and f"FAILED {broken}: FloatingPointError" in capsys.readouterr().out
    )
    error = (broken / "error.txt").read_text()
    assert "Traceback" in error and "NaN or Inf in the test" in error
    assert epochs_done(folder_of(out)) == 3
    monkeypatch.setattr(sweep.run, "train", train)
    with pytest.raises(SystemExit) as stop:
        sweep.main(["--plan", str(plan), "--out", str(out)])
    assert stop.value.code == 0 and not (broken / "error.txt").exists()


def test_a_run_that_another_process_begins_meanwhile_is_left_to_it(tmp_path, capsys, monkeypatch):
    """Many that start at once all find the first run free, and one is the first in its folder."""
    plan, out = tmp_path / "plan.txt", tmp_path / "runs"
    plan.write_text(PLAN)
    train, first = sweep.run.train, folder_of(out)

    def late(config, resume):
        if config.out == str(first) and not resume:
            train(config, resume)  # the other's
        return train(config, resume)

    monkeypatch.setattr(sweep.run, "train", late)
    with pytest.raises(SystemExit) as stop:
        sweep.main(["--plan", str(plan), "--out", str(out)])
    assert stop.value.code == 0 and "another process was the first in" in capsys.readouterr().out
    assert not (first / "error.txt").exists()


def test_environments_are_checked_with_the_settings_of_the_runs(tmp_path):
    gym.register("Lengthless-v0", Line)
    runs = [
        sweep.all_runs(["Lengthless-v0"], [variant], [0], {}, tmp_path)
        for variant in ("episode_length=7", "")
    ]
    sweep.check_environments(runs[0])
    with pytest.raises(UsageError, match="no episode length"):
        sweep.check_environments(runs[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_plan_that_is_told_to_stop_loses_no_whole_epoch(name, tmp_path):
    plan, out = tmp_path / "plan.txt", tmp_path / "runs"
    its = SMALL.replace("epochs=2", "epochs=100000")
    plan.write_text(f"--env PointMassEmptyEnv-v1 --set {its}")
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


def test_the_hours_that_are_left(tmp_path):
    """Of epochs of 90 seconds, 4 of the run that has 6 of 10, and 2 x 10 of seeds not begun."""
    make_run(tmp_path / "a", epochs=6, of=10, env="FetchReach-v1")
    common = {"env": "FetchReach-v1", "epochs": 10}
    runs = [Config(**common, seed=seed, out=str(tmp_path / "abc"[seed])) for seed in range(3)]
    runs.append(Config(env="Reacher-v2", epochs=10, out=str(tmp_path / "d")))
    runs.append(Config(env="FetchReach-v1", epochs=6, out=str(tmp_path / "a")))
    said = sweep.hours_left([settings.complete(config) for config in runs])
    assert said == (
        "4 of 4 runs are left; 3 of them need 0.6 core-hours; 1 are of a kind not timed yet"
    )


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--env PointMassEmptyEnv-v1 --variants heads=0", "line 2: --heads must be"),
        ("--env PointMassEmptyEnv-v1 --colour red", "line 2: unknown: --colour red"),
        ("--seeds 0-2", "line 2: no --env"),
        ('--env "PointMass', "line 2: No closing quotation"),
        ("--env PointMassEmptyEnv-v1 --seeds many", "line 2: argument --seeds"),
        ("--env Nowhere-v0", "cannot make the environment Nowhere-v0"),
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
    names = {(config.env, settings.variant(config)) for config in runs}
    assert {env for env, _ in names} == set(PAPER_ENVS)
    for env in PAPER_ENVS:
        others = [f"{method}_heads-1" for method in ("her", "herebp", "cher", "dtgsh")]
        its = ["vcp", "vcp_priority-uniform", "vcp_priority-variance", "vcp_acting_head-one"]
        assert {(env, name) for name in (*its, *others, *METHODS)} <= names
    last = {(config.env, settings.variant(config), config.seed): config.epochs for config in runs}
    assert last["HandManipulateEggRotate-v0", "vcp", 9] == 50
    assert runs[0].env == "FetchPush-v1" and runs[0].epochs == 20


@pytest.mark.slow
def test_a_sweep_in_ray(tmp_path, capsys):
    pytest.importorskip("ray", reason="requirements-experiments.txt is not installed")
    broken = folder_of(tmp_path, seed=1, priority="uniform")
    make_run(broken, epochs=1, env="PointMassEmptyEnv-v1", seed=1)  # with other settings
    with pytest.raises(SystemExit) as stop:
        sweep.main(arguments(tmp_path, "--seeds", "0-1"))
    out = capsys.readouterr().out
    assert stop.value.code == 1 and "3 of 4 runs are whole" in out
    assert f"FAILED {broken}: " in out and "was made with" in out
    assert epochs_done(folder_of(tmp_path, seed=1)) == 2
    assert "ray" in sys.modules
