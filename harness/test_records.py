"""Tests of a run's folder: checkpoints, kills and resumes.

A killed and resumed run must end like one that was never stopped: the same rows, timing columns
aside, and the same weights.
"""

import itertools
import multiprocessing
import os
import random
import re
import shutil
import signal
import threading
import time
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from filelock import FileLock, Timeout

import run
from ensemble import EnsembleDDPG
from harness import epoch, records
from harness.assemble import restored
from harness.errors import UsageError
from harness.records import read_rows
from harness.testing import ARGUMENTS, SMALL, assert_same_run, finish, main, start
from run import Config


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


def test_the_variances_are_of_a_part_of_what_is_stored():
    """Of every tenth of 1,000 stored rows, each kind by itself; not of rows that hold nothing."""
    rows = np.arange(2000.0)[:, None]
    data = {"obs": rows, "action": rows, "goal": rows, "hindsight": rows[:, 0] % 20 == 0}
    seen = []
    agent = SimpleNamespace(q_variance=lambda obs, *_: (seen.append(obs), obs[:, 0])[1])
    variance = epoch.variance_by_kind(agent, SimpleNamespace(data=data, size=1000), most=100)
    np.testing.assert_array_equal(seen[0][:, 0], np.arange(0, 1000, 10))
    assert variance == {"variance_hindsight": 490, "variance_original": 500}


def test_the_seconds_of_an_epoch_are_added_up(monkeypatch):
    clock = itertools.count(step=3)
    monkeypatch.setattr(epoch.time, "perf_counter", lambda: next(clock))
    notes = epoch.Epoch(1, 1, 1)
    for name in ("train", "eval", "train"):
        with notes.timed(name):
            pass
    assert notes.seconds == {"train": 6, "eval": 3}


def test_resuming_from_the_command_line(whole, tmp_path, capsys):
    folder = tmp_path / "run"
    main([*ARGUMENTS, "--epochs=1", f"--out={folder}"])
    for wrong in (["--seed=1"], ["--heads=3"], ["--temperature=5"]):
        with pytest.raises(SystemExit) as stop:
            main([f"--resume={folder}", *wrong])
        assert stop.value.code == 2 and "the run was made with" in capsys.readouterr().err
    main([f"--resume={folder}", "--epochs=4", "--temperature=9"])
    assert_same_run(whole, folder)
    about = (folder / "config.json").read_text().replace('"commit": ', '"commit": "older", "was": ')
    (folder / "config.json").write_text(about)
    main([f"--resume={folder}"])  # nothing is left to do
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
run.cli.main(run.train, sys.argv[1:])
"""


def test_killed_while_the_checkpoint_is_written(whole, tmp_path):
    folder = tmp_path / "run"
    process = start(*ARGUMENTS, "--epochs=4", f"--out={folder}", program=KILL_IN_SAVE)
    assert finish(process)[0] == -signal.SIGKILL
    main([f"--resume={folder}"])
    assert_same_run(whole, folder)
    files = {".lock", "config.json", "progress.csv", "curve.png", "checkpoint.pt"}
    assert {p.name for p in folder.iterdir()} == files


def test_a_full_disk_stops_the_run_and_keeps_the_last_epoch(whole, tmp_path):
    folder = tmp_path / "run"
    main([*ARGUMENTS, "--epochs=1", f"--out={folder}"])
    code, _, err = finish(start(f"--resume={folder}", "--epochs=4", limit=1_000_000))
    assert code == 1 and err.count("\n") == 1, err
    assert "stopped in epoch 2: " in err and "--resume" in err
    assert len(read_rows(folder)) == 1 and not list(folder.glob("*.tmp"))
    main([f"--resume={folder}", "--epochs=4"])
    assert_same_run(whole, folder)


def test_rows_that_a_deleted_run_left_are_not_this_runs(tmp_path):
    (tmp_path / "progress.csv").write_text("epoch\n1\n")
    with pytest.raises(FloatingPointError):
        run.train(Config(**SMALL, epochs=1, learning_rate=1e30, out=str(tmp_path)))
    assert records.epochs_done(tmp_path) == 0


def test_networks_that_are_not_numbers_are_not_saved(tmp_path, monkeypatch):
    """NaN in the targets, which neither act nor have a loss before the next epoch."""
    config = Config(**{**SMALL, "cycles": 1}, epochs=1, out=str(tmp_path))
    run.train(config)
    before = (tmp_path / records.CHECKPOINT).read_bytes()
    poison = lambda agent: agent.target_critic.trunk[0].fill_(float("nan"))  # noqa: E731
    monkeypatch.setattr(EnsembleDDPG, "update_targets", torch.no_grad()(poison))
    with pytest.raises(FloatingPointError, match="NaN or Inf in the networks"):
        run.train(replace(config, epochs=2), resume=True)
    assert (tmp_path / records.CHECKPOINT).read_bytes() == before


def test_a_flipped_bit_is_noticed(whole, tmp_path):
    """At 50 places of a checkpoint, in its numbers and in what holds them together."""
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    (parts, _), config = restored(folder), records.read_config(folder)
    episodes = parts.original_buffer.size
    records.restore(folder, config, parts)  # once more, in place of what is there
    assert parts.original_buffer.size == episodes > 0
    path = folder / records.CHECKPOINT
    bytes_, rng = path.read_bytes(), random.Random(0)
    with zipfile.ZipFile(path) as archive:  # its alignment's padding holds nothing to be noticed
        held = [(i.header_offset, i.file_size) for i in archive.infolist() if i.file_size > 100]
    for _ in range(50):
        offset, size = rng.choice(held)
        place = offset + 128 + rng.randrange(size - 64)
        path.write_bytes(bytes_[:place] + bytes([bytes_[place] ^ 1]) + bytes_[place + 1 :])
        with pytest.raises(UsageError, match=r"checkpoint\.pt is damaged"):
            records.restore(folder, config, parts)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("half", "damaged"),
        ("replay", "damaged"),
        ("size", "has networks or episodes of other sizes"),
        ("foreign", "another version"),
        ("pickle", "damaged"),
        ("config", "was made with another temperature than config.json says"),
    ],
)
def test_a_checkpoint_that_is_not_this_runs_is_not_trained_on(
    what, message, whole, tmp_path, capsys
):
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    path, ran = folder / records.CHECKPOINT, tmp_path / "ran"
    saved = records.read_checkpoint(path)
    networks = saved["state"]["agent"]["networks"]
    if what == "replay":
        del saved["state"]["replay"]
    elif what == "size":
        networks[1] = [p[..., :-1] for p in networks[1]]
    elif what == "foreign":
        saved = {"weights": torch.zeros(3)}
    elif what == "config":
        text = (folder / "config.json").read_text()
        (folder / "config.json").write_text(
            text.replace('"temperature": 9.0', '"temperature": 5.0')
        )
    torch.save(saved if what != "pickle" else RunsCode(ran), path)
    if what == "half":
        os.truncate(path, path.stat().st_size // 2)
    before = {p: p.stat().st_mtime_ns for p in folder.iterdir()}
    for arguments in ([f"--resume={folder}", "--epochs=5"], [f"--play={folder}"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        out, err = capsys.readouterr()
        assert stop.value.code == 2 and err.count("\n") == 1 and "Traceback" not in err
        assert re.search(message, out + err)
    assert before == {p: p.stat().st_mtime_ns for p in folder.iterdir()} and not ran.exists()


class RunsCode:
    """A pickle that makes a file when it is loaded as pickles are."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_two_processes_in_one_folder(tmp_path):
    """The second gets one line, whether the first has written already or not; the first goes on."""
    folder = tmp_path / "run"
    first = start(*ARGUMENTS, "--epochs=30", f"--out={folder}")
    while not (folder / "config.json").exists() and first.poll() is None:
        time.sleep(0.02)
    for how in ([f"--resume={folder}"], [*ARGUMENTS, f"--out={folder}"]):
        code, _, err = finish(start(*how, "--epochs=30"))
        assert code == 2 and err.count("\n") == 1, err
        assert "another process trains in" in err or "already holds a run" in err
    assert finish(first)[0] == 0 and len(read_rows(folder)) == 30
    main([f"--resume={folder}", "--epochs=31"])  # the lock is gone with its process


def test_the_checkpoint_is_read_when_no_other_process_can_write_it(whole, tmp_path, monkeypatch):
    folder, restore = shutil.copytree(whole, tmp_path / "run"), records.restore

    def locked(*args):
        with pytest.raises(Timeout):
            FileLock(folder / ".lock", timeout=0).acquire()
        return restore(*args)

    monkeypatch.setattr(records, "restore", locked)
    main([f"--resume={folder}", "--epochs=5"])
    assert len(read_rows(folder)) == 5
