"""The folder of a run: config.json (what was asked), progress.csv (a row an epoch), curve.png and
checkpoint.pt (all that is needed to go on).

Each file is written beside its place and moved there when it is whole, so whatever happens, each
file in the folder is whole: it is the last epoch's or that of the epoch before.
"""

import csv
import io
import json
import os
import platform
import shlex
import subprocess
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from filelock import FileLock, Timeout

from harness.errors import FolderInUse, UsageError

PACKAGES = ("numpy", "torch", "gymnasium", "gymnasium-robotics", "mujoco")
CHECKPOINT = "checkpoint.pt"
FORMAT = 7  # of checkpoints; others are refused
MAY_CHANGE = ("epochs", "out", "device", "threads", "num_workers")  # when a run is resumed


def to_type(option: str, folder: Path) -> str:
    """A command that goes on with a run or plays it, from any folder."""
    program = Path(__file__).parent.parent / "run.py"
    words = ["python", str(program), option, str(folder)]
    return subprocess.list2cmdline(words) if os.name == "nt" else shlex.join(words)


def write_whole(path: Path, write) -> None:
    """Make the file at `path` what write(binary file) writes, all of it or nothing."""
    temporary = path.with_name(path.name + ".tmp")  # `held` leaves it to one process
    try:
        with open(temporary, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_config(folder: Path, config: dict) -> None:
    """config.json: the settings, the versions and the commit of the code."""
    versions = {"python": platform.python_version()} | {p: version(p) for p in PACKAGES}
    about = {"config": config, "versions": versions, "commit": _commit()}
    text = json.dumps(about, indent=2) + "\n"
    write_whole(folder / "config.json", lambda file: file.write(text.encode()))


def read_config(folder: Path) -> dict:
    """The settings of the run in `folder`. UsageError if there is none."""
    try:
        return json.loads((folder / "config.json").read_text())["config"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{folder} does not hold a run: no readable config.json") from error


@contextmanager
def held(folder: Path, resume: bool) -> Iterator[None]:
    """Make the run's folder, this process's alone in the block. UsageError if it holds a run that
    is not resumed, if another process has it, or if it cannot be written to."""
    lock = FileLock(folder / ".lock", timeout=0)  # any death of the process releases it
    try:
        _refuse_another(folder, resume)
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout as error:
        raise FolderInUse(f"another process trains in {folder}") from error
    except OSError as error:
        raise UsageError(f"cannot write to {folder}: {error.strerror or error}") from error
    try:
        _refuse_another(folder, resume)  # one that was faster
        yield
    finally:
        lock.release()


def begin(folder: Path, config: dict, parts, resume: bool) -> list[dict]:
    """With `resume`, bring the assemble.Parts to the checkpoint's state. Returns the rows so far. A
    finished run's config.json keeps the commit and versions that made it. UsageError as in
    `restore`."""
    rows = restore(folder, config, parts) if resume else []
    if len(rows) < config["epochs"]:
        write_config(folder, config)
    if rows:
        write_rows(folder, rows, config)
    else:
        (folder / "progress.csv").unlink(missing_ok=True)  # of a run whose config.json is gone
    return rows


def _refuse_another(folder: Path, resume: bool) -> None:
    if not resume and (folder / "config.json").exists():
        raise UsageError(f"{folder} already holds a run: --resume it, or choose another --out")


def save(folder: Path, config: dict, rows: list[dict], state: dict) -> None:
    """The end of an epoch: checkpoint.pt, then progress.csv and curve.png. state: what
    `assemble.Parts.state` gives. FloatingPointError, and nothing written, for NaN or Inf in the
    networks."""
    if not all(p.isfinite().all() for net in state["agent"]["networks"] for p in net):
        raise FloatingPointError("NaN or Inf in the networks")
    save_checkpoint(folder, {"config": config, "rows": rows, "state": as_tensors(state)})
    write_rows(folder, rows, config)


def as_tensors(state):
    """A state with tensors for its arrays, as PyTorch reads no arrays without running code."""
    if isinstance(state, dict):
        return {name: as_tensors(x) for name, x in state.items()}
    if isinstance(state, (list, tuple)):
        return type(state)(map(as_tensors, state))
    return torch.from_numpy(state) if isinstance(state, np.ndarray) else state


def write_rows(folder: Path, rows: list[dict], config: dict) -> None:
    """progress.csv, with the columns of `Epoch.row`, and curve.png."""
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, rows[0])
    table.writeheader()
    table.writerows(rows)
    write_whole(folder / "progress.csv", lambda file: file.write(text.getvalue().encode()))
    _draw_curve(folder, rows, config)


def read_rows(folder: Path) -> list[dict[str, float]]:
    """progress.csv, one dict an epoch."""
    with open(folder / "progress.csv", newline="") as file:
        return [{name: float(x) for name, x in row.items()} for row in csv.DictReader(file)]


def epochs_done(folder: Path) -> int:
    """How many whole epochs progress.csv has; 0 if it is not there yet, or not readable."""
    try:
        return len(read_rows(folder))
    except (OSError, ValueError, TypeError):  # the checkpoint says what to go on with
        return 0


def save_checkpoint(folder: Path, content: dict) -> None:
    """checkpoint.pt. content: tensors and plain Python alone."""

    def write(file):
        try:
            torch.save({"format": FORMAT, **content}, file)
        except RuntimeError as error:  # torch's own, from closing its archive on a full disk
            raise error.__context__ if isinstance(error.__context__, OSError) else error from None

    write_whole(folder / CHECKPOINT, write)


def read_checkpoint(path: Path) -> dict:
    """A checkpoint, all of it as it was written. It cannot run code. UsageError for one of another
    version; any other error for one that is damaged, down to a single bit."""
    with zipfile.ZipFile(path) as archive:  # PyTorch does not look at the checksums
        if archive.testzip() is not None:
            raise zipfile.BadZipFile("wrong checksum")
    saved = torch.load(path, map_location="cpu", weights_only=True)
    if saved.get("format") != FORMAT:
        raise UsageError(f"{path} is a checkpoint of another version")
    return saved


def restore(folder: Path, config: dict, parts) -> list[dict]:
    """Bring the assemble.Parts to the state of the checkpoint. Returns its rows, none if there is
    none yet. UsageError for a damaged one, for one of another version or of other settings than
    `config`, those aside that a resumed run may change, and where rows are there without it."""
    path = folder / CHECKPOINT
    if not path.exists():
        if epochs := epochs_done(folder):
            raise UsageError(f"{folder} has {epochs} epochs in progress.csv and no {CHECKPOINT}")
        return []
    try:
        saved = read_checkpoint(path)
        differ = [k for k, v in saved["config"].items() if k not in MAY_CHANGE and config[k] != v]
        if differ:
            raise UsageError(f"{path} was made with another {differ[0]} than config.json says")
        if _sizes(saved["state"]) != _sizes(parts.state()):
            changed = "networks or episodes of other sizes, as if the environment had changed"
            raise UsageError(f"{path} has {changed}")
        parts.load_state(saved["state"])
    except UsageError:
        raise
    except Exception as error:  # whatever a damaged file leads to
        raise UsageError(f"{path} is damaged ({type(error).__name__})") from error
    return saved["rows"]


def _sizes(state: dict) -> list:
    """The shapes of an agent's tensors and of an episode of B_o."""
    shapes = [p.shape for network in state["agent"]["networks"] for p in network]
    return shapes + [x.shape[1:] for x in state["episodes"].values()]


def _draw_curve(folder: Path, rows: list[dict], config: dict) -> None:
    from matplotlib.figure import Figure  # half a second that only this needs

    epochs = [row["epoch"] for row in rows]
    fig = Figure(figsize=(6, 3.6), layout="constrained")
    ax = fig.subplots()
    for column, label, style in (
        ("test_success_rate", "test, no noise", "o-"),
        ("train_success_rate", "training, with exploration", ":"),
    ):
        ax.plot(epochs, [row[column] for row in rows], style, markersize=3, label=label)
    ax.set(xlabel="epoch", ylabel="success rate", ylim=(-0.03, 1.03))
    ax.xaxis.get_major_locator().set_params(integer=True)
    ax.set_title(f"{config['method'].upper()} on {config['env']}, seed {config['seed']}")
    ax.legend(loc="lower right")
    ax.grid(alpha=0.3)
    write_whole(folder / "curve.png", lambda file: fig.savefig(file, dpi=110, format="png"))


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
