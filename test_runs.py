"""Tests of what surrounds the algorithm: checkpoints, kills and resumes, bad input, playing.

A killed and resumed run must end like one that was never stopped: the same rows, timing columns
aside, and the same weights.
"""

import importlib.util
import json
import math
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from PIL import Image

import envs_point
import options
import records
import run
from envs_point import UsageError
from options import Config
from play import play
from records import TIMING_COLUMNS, load_checkpoint, read_rows
from workers import ParallelEnvs

HERE = Path(__file__).parent
SMALL = {
    "env": "PointMassEmptyEnv-v1",
    "cycles": 2,
    "updates": 2,
    "batch_size": 16,
    "heads": 2,
    "eval_episodes": 16,
    "num_workers": 1,
}
ARGUMENTS = [f"{options.flag(k)}={v}" for k, v in SMALL.items()]


def start(*arguments, program=None, limit=None):
    """run.py (or a program's text) in a process and session of its own, which Ctrl-C reaches even
    if these tests run in the background; with a limit on the size of the files it may write."""

    def prepare():
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        if limit:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    what = ["-c", program] if program else [str(HERE / "run.py")]
    return subprocess.Popen(
        [sys.executable, *what, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(HERE), "OMP_NUM_THREADS": "1"},
        preexec_fn=prepare,
    )


def finish(process):
    """Exit code, stdout and stderr."""
    out, err = process.communicate(timeout=600)
    return process.returncode, out, err


def tensors(state):
    """All tensors and numbers of a checkpoint, in order."""
    if isinstance(state, dict):
        state = list(state.values())
    if isinstance(state, (list, tuple)):
        return [t for part in state for t in tensors(part)]
    return [state]


def assert_same_run(a, b):
    """The same rows and the same learned state, timing aside."""
    rows = [
        [{k: v for k, v in row.items() if k not in TIMING_COLUMNS} for row in read_rows(folder)]
        for folder in (a, b)
    ]
    assert rows[0] == rows[1]
    first, second = (tensors(load_checkpoint(folder)["parts"]) for folder in (a, b))
    assert len(first) == len(second) > 100
    for x, y in zip(first, second, strict=True):
        assert torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of 4 epochs that nothing stopped."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    run.train(Config(**SMALL, epochs=4, out=str(folder)))
    return folder


# ------------------------------------------------------------------------------ resuming


def test_a_resumed_run_equals_an_uninterrupted_one(whole, tmp_path):
    folder = tmp_path / "run"
    run.train(Config(**SMALL, epochs=2, out=str(folder)))
    rows = run.train(Config(**SMALL, epochs=4, out=str(folder)), resume=True)
    assert len(rows) == 4
    seconds = [row["wall_seconds"] for row in rows]
    assert seconds == sorted(seconds)
    assert_same_run(whole, folder)


def test_a_resumed_run_of_a_robot_equals_an_uninterrupted_one(tmp_path):
    settings = {**SMALL, "env": "FetchPush-v1", "cycles": 1, "num_workers": 2, "temperature": 5.0}
    run.train(Config(**settings, epochs=2, out=str(tmp_path / "whole")))
    for epochs, resume in ((1, False), (2, True)):
        run.train(Config(**settings, epochs=epochs, out=str(tmp_path / "parts")), resume)
    assert_same_run(tmp_path / "whole", tmp_path / "parts")
    assert not multiprocessing.active_children() and threading.active_count() == 1
    settings = {**settings, "env": "Broken-v0", "out": str(tmp_path / "broken")}
    with pytest.raises(FloatingPointError):
        run.train(Config(**settings))
    assert not multiprocessing.active_children() and threading.active_count() == 1


def test_resuming_from_the_command_line(whole, tmp_path, capsys):
    folder = tmp_path / "run"
    run.main([*ARGUMENTS, "--epochs=1", f"--out={folder}"])
    for wrong in (["--seed=1"], ["--heads=3"], ["--temperature=5"]):
        with pytest.raises(SystemExit) as stop:
            run.main([f"--resume={folder}", *wrong])
        assert stop.value.code == 2 and "the run was made with" in capsys.readouterr().err
    run.main([f"--resume={folder}", "--epochs=4", "--temperature=9"])
    assert_same_run(whole, folder)
    about = (folder / "config.json").read_text().replace('"commit": ', '"commit": "older", "was": ')
    (folder / "config.json").write_text(about)
    run.main([f"--resume={folder}"])  # nothing is left to do
    assert_same_run(whole, folder)
    assert (folder / "config.json").read_text() == about


@pytest.mark.slow
def test_killed_at_ten_random_moments(whole, tmp_path):
    folder, rng = tmp_path / "run", random.Random(0)

    def go_on():
        begun = (folder / "config.json").exists()
        how = [f"--resume={folder}"] if begun else [*ARGUMENTS, f"--out={folder}"]
        return start(*how, "--epochs=4")

    began = time.monotonic()
    assert finish(start(*ARGUMENTS, f"--out={tmp_path / 'timed'}", "--epochs=4"))[0] == 0
    seconds = time.monotonic() - began  # half of it to import PyTorch
    for _ in range(10):
        process = go_on()
        time.sleep(rng.uniform(0.1, 1) * seconds)
        os.killpg(process.pid, signal.SIGKILL)
        finish(process)
    code, _, err = finish(go_on())
    assert code == 0, err
    assert_same_run(whole, folder)


KILL_IN_SAVE = """
import os, signal, sys, torch, run
save, saves = torch.save, []
def half(state, file):
    saves.append(1)
    save(state, file)
    if len(saves) == 2:
        file.flush()
        file.truncate(file.tell() // 2)
        os.kill(os.getpid(), signal.SIGKILL)
torch.save = half
run.main(sys.argv[1:])
"""
KILL_BETWEEN_RENAMES = """
import os, signal, sys, run
replace, moved = os.replace, []
def one(a, b):
    replace(a, b)
    if str(b).endswith("previous.pt"):
        os.kill(os.getpid(), signal.SIGKILL)
os.replace = one
run.main(sys.argv[1:])
"""


@pytest.mark.parametrize("program", [KILL_IN_SAVE, KILL_BETWEEN_RENAMES], ids=["save", "rename"])
def test_killed_while_the_checkpoint_is_written(program, whole, tmp_path):
    folder = tmp_path / "run"
    process = start(*ARGUMENTS, "--epochs=4", f"--out={folder}", program=program)
    assert finish(process)[0] == -signal.SIGKILL
    run.main([f"--resume={folder}"])
    assert_same_run(whole, folder)
    assert {p.name for p in folder.iterdir()} == {
        "config.json", "progress.csv", "curve.png", records.CHECKPOINT, records.PREVIOUS,
    }  # fmt: skip


def test_a_full_disk_stops_the_run_and_keeps_the_last_epoch(whole, tmp_path):
    folder = tmp_path / "run"
    run.main([*ARGUMENTS, "--epochs=1", f"--out={folder}"])
    code, _, err = finish(start(f"--resume={folder}", "--epochs=4", limit=1_000_000))
    assert code == 1 and err.count("\n") == 1, err
    assert "stopped in epoch 2: " in err and "--resume" in err
    assert len(read_rows(folder)) == 1 and not list(folder.glob("*.tmp"))
    run.main([f"--resume={folder}", "--epochs=4"])
    assert_same_run(whole, folder)


def test_a_damaged_checkpoint_is_refused_and_the_one_before_is_used(whole, tmp_path, capsys):
    folder = tmp_path / "run"
    run.main([*ARGUMENTS, "--epochs=2", f"--out={folder}"])
    path = folder / records.CHECKPOINT
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    run.main([f"--resume={folder}", "--epochs=4"])
    assert "is damaged" in capsys.readouterr().out
    assert_same_run(whole, folder)
    for name in (records.CHECKPOINT, records.PREVIOUS):
        (folder / name).write_bytes(b"PK" + bytes(1000))
    before = sorted((p.name, p.stat().st_mtime) for p in folder.iterdir())
    with pytest.raises(SystemExit) as stop:
        run.main([f"--resume={folder}"])
    err = capsys.readouterr().err
    assert stop.value.code == 2 and "damaged" in err and err.count("\n") == 1
    assert before == sorted((p.name, p.stat().st_mtime) for p in folder.iterdir())


@pytest.mark.parametrize("option", ["--resume", "--play"])
def test_a_checkpoint_of_another_version_is_refused(option, tmp_path, capsys):
    run.main([*ARGUMENTS, "--epochs=1", f"--out={tmp_path}"])
    path = tmp_path / records.CHECKPOINT
    torch.save({**torch.load(path, weights_only=True), "format": 1}, path)
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        run.main([f"{option}={tmp_path}"])
    err = capsys.readouterr().err
    assert stop.value.code == 2 and "another version" in err and err.count("\n") == 1


# ------------------------------------------------------------------------------ stopping


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
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL, "worker"])
def test_nothing_is_left_running(sent, tmp_path):
    folder = tmp_path / "run"
    arguments = [a for a in ARGUMENTS if "workers" not in a]
    process = start(*arguments, "--num-workers=2", "--epochs=1000", f"--out={folder}")
    while not (folder / records.CHECKPOINT).exists() and process.poll() is None:
        time.sleep(0.05)
    workers = children(process.pid)
    assert len(workers) == 2
    if sent == "worker":
        os.kill(int(workers[0]), signal.SIGKILL)
    elif sent == signal.SIGINT:
        os.killpg(process.pid, sent)  # a terminal's Ctrl-C goes to the whole group
    else:
        process.send_signal(sent)
    code, _, err = finish(process)
    assert gone(workers)
    if sent == signal.SIGINT:
        assert code == 130 and f"--resume {folder}" in err and "Traceback" not in err, err
    if sent == "worker":
        assert code == 1 and "died (exit code -9" in err and "PointMassEmptyEnv-v1" in err
        assert "Traceback" not in err
    assert len(load_checkpoint(folder)["rows"]) >= 1


class Broken(envs_point.PointMass):
    """Gives a NaN at step 7."""

    def step(self, action):
        self.steps = getattr(self, "steps", 0) + 1
        obs, *rest = super().step(action)
        if self.steps == 7:
            obs["observation"][1] = math.nan
        return obs, *rest


class BrokenReward(envs_point.PointMass):
    """Gives a NaN for goals far to the right."""

    def compute_reward(self, achieved_goal, desired_goal, info):
        reward = super().compute_reward(achieved_goal, desired_goal, info)
        return np.where(np.asarray(achieved_goal)[..., 0] > 0.5, np.nan, reward)

    def reset(self, **kwargs):
        super().reset(**kwargs)
        self._xy = self._goal = (0.3, 0.0)
        return self._observe(), {}


class Hasty(envs_point.PointMass):
    """Ends its episodes at step 7."""

    def step(self, action):
        self.steps = getattr(self, "steps", 0) + 1
        obs, reward, _, _, info = super().step(action)
        return obs, reward, self.steps == 7, False, info


gym.register("Hasty-v0", Hasty, max_episode_steps=10)
gym.register("Broken-v0", Broken, max_episode_steps=10)
gym.register("BrokenReward-v0", BrokenReward, max_episode_steps=50)


def test_a_nan_stops_the_run_and_says_where(tmp_path):
    settings = {**SMALL, "env": "Broken-v0", "out": str(tmp_path / "run"), "epochs": 1}
    with pytest.raises(FloatingPointError, match="obs of an episode"):
        run.train(Config(**settings))
    assert threading.active_count() == 1
    settings = {**SMALL, "env": "BrokenReward-v0", "out": str(tmp_path / "reward"), "epochs": 1}
    with pytest.raises(FloatingPointError, match="in the rewards"):
        run.train(Config(**settings))
    settings = {**SMALL, "out": str(tmp_path / "lr"), "epochs": 1, "learning_rate": 1e30}
    with pytest.raises(FloatingPointError, match="variance of the Q-values"):
        run.train(Config(**settings))


@pytest.mark.parametrize("workers", [1, 2])
def test_an_environment_that_ends_its_episodes_early_is_refused(workers, tmp_path, capfd):
    arguments = [a for a in ARGUMENTS if not a.startswith(("--env", "--num-workers"))]
    with pytest.raises(SystemExit) as stop:
        run.main([*arguments, "--env=Hasty-v0", f"--num-workers={workers}", f"--out={tmp_path}/r"])
    assert stop.value.code == 2 and not multiprocessing.active_children()
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "epoch" not in line]
    assert line == "run.py: Hasty-v0 ended an episode early: HER here needs a fixed length"


def test_a_worker_that_dies_is_reported():
    with pytest.raises(ChildProcessError, match=r"worker process of Reacher-v2 .*-9"):
        with ParallelEnvs("Reacher-v2", 4, 2) as envs:
            envs.reset(0)
            os.kill(envs.workers[1]._env.processes[0].pid, signal.SIGKILL)
            run.rollout(envs, lambda t, rows, obs, goal: np.zeros((2, 2)), 3)


# ------------------------------------------------------------------------------ bad input

BAD = [
    ("--env FetchRech-v1", "FetchReach-v1"),
    ("--env CartPole-v1", "no goals"),
    ("--env FetchReach-v2", "FetchReach-v4"),
    ("--env FetchReachDense-v4", "-1 and 0"),
    ("--env PointMaze_UMaze-v3", "-1 and 0"),
    ("--env nowhere:Env-v0", "nowhere"),
    ("--env=", "cannot make"),
    ("--method sac", "--method"),
    ("--epochs 0", "--epochs must be 1 or more"),
    ("--epochs many", "--epochs"),
    ("--epochs 1.5", "--epochs"),
    ("--cycles 0", "--cycles must be 1 or more"),
    ("--updates -1", "--updates must be 1 or more"),
    ("--batch-size 0", "--batch-size must be 1 or more"),
    ("--eval-episodes 0", "--eval-episodes must be 1 or more"),
    ("--heads 0", "--heads must be 1 or more"),
    ("--num-workers 0", "--num-workers must be 1 or more"),
    ("--seed -1", "--seed must be 0 or more"),
    ("--temperature nan", "--temperature must be a finite number"),
    ("--temperature inf", "--temperature must be a finite number"),
    ("--temperature hot", "--temperature"),
    ("--priority energy", "--priority"),
    ("--method her --priority variance", "--priority goes with --method vcp"),
    ("--method cher --temperature 5", "--temperature goes with --method vcp"),
    ("--method cher --batch-size 1", "--batch-size 2 or more"),
    ("--method her --faithful", "--faithful does not go with --method her"),
    ("--importance yes", "--importance"),
    ("--acting-head none", "--acting-head"),
    ("--device tpu", "--device"),
    ("--nonsense", "--nonsense"),
    ("--out full", "already holds a run"),
    ("--out full/config.json/below", "cannot write"),
    ("--resume nowhere", "does not hold a run"),
    ("--resume broken", "does not hold a run"),
    ("--resume older", "another version"),
    ("--play nowhere", "does not hold a run"),
    ("--play full", "no whole epoch"),
    ("--gif a.gif", "--gif goes with --play"),
    ("--play full --resume full", "do not go together"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[b[0] for b in BAD])
def test_bad_input_gets_one_line_and_exit_code_2(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    older = json.dumps({"config": {"no_such_setting": 1}})
    for name, text in (("full", json.dumps({"config": SMALL})), ("broken", "{"), ("older", older)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(text)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}
    ours = [] if "--resume" in arguments or "--play" in arguments else ["--env", SMALL["env"]]
    with pytest.raises(SystemExit) as stop:
        run.main([*ours, *arguments.split()])
    out, err = capsys.readouterr()
    assert stop.value.code == 2
    assert out == "" and err.count("\n") == 1 and message in err and "Traceback" not in err
    assert before == {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_missing_device_is_named():
    with pytest.raises(UsageError, match="no CUDA device"):
        options.complete(Config(device="cuda"))
    assert options.complete(Config(device="auto")).device == "cpu"


def test_a_missing_tensorboard_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match="pip install tensorboard"):
        options.complete(Config(tensorboard=True))


def test_help_names_every_option_and_default(capsys):
    with pytest.raises(SystemExit) as stop:
        run.main(["--help"])
    text = re.sub(r"\s+", " ", capsys.readouterr().out)
    assert stop.value.code == 0
    for name in ("--her-thread", "--acting-head", "--resume", "--play", "--gif", "--tensorboard"):
        assert name in text
    assert "𝒯 in Eq. (4)" in text and "(default: 9.0)" in text and "(default: 16)" in text


# ------------------------------------------------------------------------------ playing


def test_playing_a_run(whole, tmp_path, capsys):
    folder, picture = tmp_path / "from_a_gpu", tmp_path / "a.gif"
    shutil.copytree(whole, folder)
    records.write_config(folder, {**records.read_config(whole), "device": "cuda"})
    rates = play(folder, str(picture))
    out = capsys.readouterr().out
    assert rates.shape == (2,) and np.all((rates >= 0) & (rates <= 1))
    assert f"success {rates.mean():.3f} over 20 episodes" in out and "after epoch 4" in out
    with Image.open(picture) as gif:
        assert gif.size == (240, 240) and gif.n_frames > 20
        frames = []
        for i in range(gif.n_frames):
            gif.seek(i)
            frames.append(np.asarray(gif.convert("RGB")).astype(int))
    assert np.abs(np.diff(frames, axis=0)).max() > 50  # something moves
