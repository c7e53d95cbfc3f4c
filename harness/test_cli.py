"""Tests of the command line: bad input, what ends a run, what is left behind."""

import json
import os
import re
import shlex
import signal
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

import run
from ensemble import EnsembleDDPG
from harness import records
from harness.records import read_checkpoint
from harness.settings import flag
from harness.testing import ARGUMENTS, HERE, SMALL, command, finish, main, start, wait_for_an_epoch
from run import Config


def test_the_command_line_from_another_folder(tmp_path):
    arguments = "--env PointMassEmptyEnv-v1 --epochs 1 --cycles 2 --updates 1 --batch-size 16"
    code, out, err = command(*arguments.split(), "--eval-episodes", "16", cwd=tmp_path)
    assert code == 0 and out.startswith("PointMassEmptyEnv-v1: our NumPy version"), err
    assert max(map(len, out.splitlines()[:-1])) <= 80 and "epoch 1/1" in out and "success" in out
    name = "vcp_cycles-2_updates-1_batch_size-16_eval_episodes-16"
    folder = Path("runs", "PointMassEmptyEnv-v1", name, "seed0")
    last = out.splitlines()[-1]
    folder = tmp_path / folder
    assert last.endswith(shlex.join(["python", str(HERE / "run.py"), "--play", str(folder)]))
    files = {"config.json", "progress.csv", "curve.png", "checkpoint.pt", ".lock"}
    assert files == {p.name for p in folder.iterdir()}
    settings = json.loads((folder / "config.json").read_text())
    assert settings["config"]["updates"] == 1 and settings["versions"]["mujoco"]


def children(pid):
    return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()


def gone(pids):
    """Whether no process of these is left, waiting a little for the last."""
    for _ in range(100):
        left = [p for p in pids if Path(f"/proc/{p}").exists()]
        if not left:
            return True
        time.sleep(0.1)
    return False


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks for processes in /proc")
@pytest.mark.parametrize("sent", ["SIGINT", "SIGTERM", "SIGHUP", "SIGKILL", "worker"])
def test_nothing_is_left_running(sent, tmp_path):
    folder = tmp_path / "run"
    arguments = [a for a in ARGUMENTS if "workers" not in a]
    process = start(*arguments, "--num-workers=2", "--epochs=1000", f"--out={folder}")
    wait_for_an_epoch(process, folder)
    workers = children(process.pid)
    assert len(workers) == 2
    if sent == "worker":
        os.kill(int(workers[0]), signal.SIGKILL)
    elif sent == "SIGKILL":
        process.kill()
    else:  # a terminal's Ctrl-C goes to the whole group
        os.killpg(process.pid, getattr(signal, sent))
    code, _, err = finish(process)
    assert gone(workers)
    if sent not in ("worker", "SIGKILL"):
        assert code == 130 and f"--resume {folder}" in err and err.count("\n") == 1, err
    if sent == "worker":
        assert code == 1 and "died (exit code -9" in err and "PointMassEmptyEnv-v1" in err
        assert "Traceback" not in err
    assert len(read_checkpoint(folder / "checkpoint.pt")["rows"]) >= 1


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="there are no hang-ups")
def test_a_hangup_that_nohup_ignores_is_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with pytest.raises(SystemExit):
            main(["--help"])
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_nan_stops_the_run_and_says_where(tmp_path, monkeypatch):
    settings = {**SMALL, "out": str(tmp_path / "act"), "epochs": 1}
    with monkeypatch.context() as patch, pytest.raises(FloatingPointError, match="in the networks"):
        patch.setattr(EnsembleDDPG, "act", lambda self, *args: np.full((2, 8, 2), np.nan))
        run.train(Config(**settings))
    settings = {**SMALL, "out": str(tmp_path / "lr"), "epochs": 1, "learning_rate": 1e30}
    with pytest.raises(FloatingPointError, match="variance of the Q-values"):
        run.train(Config(**settings))


LIMITS = {
    "must be 1 or more": "--epochs 0 --cycles 0 --updates -1 --batch-size 0 --eval-episodes 0"
    " --heads 0 --num-workers 0 --threads 0 --heads-at-once 0 --her-buffer-capacity 0"
    " --episode-length 0",
    "must be 0 or more": "--seed -1 --relabel-ratio -0.1 --noise -1 --action-penalty -1"
    " --temperature -1 --polyak -1 --random-actions -1",
    "must be 1 or less": "--relabel-ratio 80 --polyak 1.5 --random-actions 2",
    "must be above 0": "--learning-rate -1 --scored-per-drawn 0",
    "must be a finite number": "--temperature nan --temperature inf --learning-rate nan",
    "invalid": "--epochs many --epochs 1.5 --temperature hot --method sac --priority energy"
    " --importance yes --acting-head none --device tpu",
}
WORDS = {words: pairs.split() for words, pairs in LIMITS.items()}

BAD = [
    ("--env FetchRech-v1", "Did you mean: `FetchReach`?"),
    ("--env CartPole-v1", "no goals"),
    ("--env FetchReach-v2", "FetchReach-v4"),
    ("--env FetchReachDense-v4", "must give -1 and 0 (reached), or 0 and 1"),
    ("--env nowhere:Env-v0", "nowhere"),
    ("--env her:Mine-v0", "the module is /"),  # this project's her.py, and not theirs
    ("--env=", "Malformed environment ID"),
    ("--method her --priority variance", "--priority goes with --method vcp"),
    ("--method her --importance none", "--importance goes with --method vcp"),
    ("--method dtgsh --scored-per-drawn 2", "--scored-per-drawn goes with --method vcp"),
    ("--method herebp --her-buffer-capacity 99999", "--her-buffer-capacity goes with --method vcp"),
    ("--priority uniform --temperature 5", "--temperature changes nothing with --priority uniform"),
    (
        "--priority uniform --importance none",
        "--importance changes nothing with --priority uniform",
    ),
    ("--method cher --temperature 5", "--temperature goes with --method vcp"),
    ("--method cher --batch-size 1", "--batch-size 2 or more"),
    ("--nonsense", "--nonsense"),
    ("--heads-at-once 3", "--heads-at-once must divide the"),
    ("--scored-per-drawn 0.00001", "--scored-per-drawn must be"),
    ("--her-buffer-capacity 9", "are scored at once, and B_h holds 9"),
    ("--buffer-size 799", "--buffer-size must hold 16 episodes of 50 steps"),
    ("--seed 18446744073709551616", "--seed must be 4294967295 or less"),
    ("--heads 10000000", "lower --heads"),
    ("--batch-size 1000000000", "lower --heads, --batch-size"),
    ("--buffer-size 100000000000", "lower --heads, --batch-size, --buffer-size"),
    ("--batch 16", "--batch"),
    ("--env a:b:c-v0", "cannot learn in the environment a:b:c-v0"),
    ("--env ../x:Y", "cannot learn in the environment ../x:Y"),
    ("--env :X", "cannot learn in the environment :X"),
    ("--env broken_module:Own-v0", "SyntaxError"),
    ("--resume=", "--resume needs a name"),
    ("--play=", "--play needs a name"),
    ("--play full --gif=", "--gif needs a name"),
    ("--play full --gif a.mp3", "its ending must be one of .gif"),
    ("--play full --policy a.pt", "its ending must be .npz"),
    ("--policy a.npz", "--policy goes with --play"),
    ("--play full --policy no/a.npz", "--policy no/a.npz: there is no folder no"),
    ("--play full --gif no/a.gif", "--gif no/a.gif: there is no folder no"),
    ("--play full/config.json", "holds no policy"),
    ("--resume typed", "--epochs must be of type int"),
    ("--resume list", "another version"),
    (f"--out {300 * 'x'}", "cannot write"),
    ("--out full", "already holds a run"),
    ("--out full/config.json/below", "cannot write"),
    ("--resume nowhere", "does not hold a run"),
    ("--resume broken", "does not hold a run"),
    ("--resume older", "another version"),
    ("--play nowhere", "does not hold a run"),
    ("--play full", "no whole epoch"),
    ("--gif a.gif", "--gif goes with --play"),
    ("--play full --resume full", "do not go together"),
    ("--play full --eval-episodes 9", "--eval-episodes does not go with --play"),
    ("--resume full --epochs 9 --out b", "--out does not go with --resume"),
]
BAD += [
    (f"{option} {value}", f"{option} {words}" if words.startswith("must") else option)
    for words, pairs in WORDS.items()
    for option, value in zip(pairs[::2], pairs[1::2], strict=True)
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[b[0] for b in BAD])
def test_bad_input_gets_one_line_and_exit_code_2(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    older = json.dumps({"config": {"no_such_setting": 1}})
    for name, text in (
        ("full", json.dumps({"config": SMALL})),
        ("broken", "{"),
        ("older", older),
        ("typed", json.dumps({"config": {**SMALL, "epochs": "3"}})),
        ("list", json.dumps({"config": [1]})),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(text)
    (tmp_path / "broken_module.py").write_text("def (")
    monkeypatch.setattr(records, "begin", lambda *_: pytest.fail("it trains"))
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}
    ours = [] if "--resume" in arguments or "--play" in arguments else ["--env", SMALL["env"]]
    with pytest.raises(SystemExit) as stop:
        main([*ours, *arguments.split()])
    out, err = capsys.readouterr()
    assert stop.value.code == 2
    assert out == "" and err.count("\n") == 1 and message in err and "Traceback" not in err
    assert before == {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}


def test_help_names_every_option_and_default(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    text = re.sub(r"\s+", " ", capsys.readouterr().out)
    assert stop.value.code == 0
    options = [flag(f.name) for f in fields(Config)]
    assert {*options, "--resume", "--play", "--gif", "--policy"} <= {*text.split()}
    assert "𝒯 in Eq. (4)" in text and "(default: 9.0)" in text and "(default: 16)" in text


HANGS = r"""
import os, sys, time, gymnasium, run
from envs_point import PointMass
class Hangs(PointMass):
    steps = 0
    def step(self, action):
        self.steps += 1
        if self.steps > 900:
            os.write(1, b"hangs\n")  # whole, where two workers write at once
            time.sleep(600)
        return super().step(action)
gymnasium.register("Hangs-v0", Hangs, max_episode_steps=50)
run.cli.main(run.train, sys.argv[1:])
"""


@pytest.mark.parametrize("workers", [1, 2])
def test_an_environment_that_hangs_is_left_by_one_ctrl_c(workers, tmp_path):
    arguments = [a for a in ARGUMENTS if not a.startswith(("--env", "--num-workers"))]
    more = ["--env=Hangs-v0", f"--num-workers={workers}", "--epochs=9", f"--out={tmp_path / 'r'}"]
    process = start(*arguments, *more, program=HANGS)
    assert "hangs\n" in process.stdout  # reads on until it is there
    workers_left = children(process.pid)
    os.killpg(process.pid, signal.SIGINT)
    process.communicate(timeout=20)
    assert process.returncode == 130 and gone(workers_left)


def test_before_there_is_anything_to_go_on_with_the_line_does_not_say_so(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*ARGUMENTS, "--epochs=1", "--learning-rate=1e30", f"--out={tmp_path / 'run'}"])
    err = [line for line in capsys.readouterr().err.splitlines() if "run.py" in line]
    assert stop.value.code == 1 and len(err) == 1 and "--resume" not in err[0]
