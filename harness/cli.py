"""The command line of run.py: options, messages, exit codes."""

import argparse
import contextlib
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import NoReturn

from harness import records, settings
from harness.errors import EnvironmentFailed, UsageError
from harness.settings import Config

ANIMATIONS = (".gif", ".webp", ".png")
STOPS = (FloatingPointError, OSError, MemoryError, EnvironmentFailed, KeyboardInterrupt)


def main(train: Callable, argv: list[str] | None = None) -> None:
    """Train, resume or play, as the arguments say. Exit code 2 and one line for bad input, 1 and
    one line for a run that something outside the program stopped, 130 for Ctrl-C."""
    sys.path.append(os.getcwd())  # for the user's own module:ID
    for name in ("SIGTERM", "SIGHUP"):  # as Ctrl-C, but for what nohup has ignored
        number = getattr(signal, name, None)
        if number and signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)
    given, command = parse(argv)
    try:
        if command.play is not None:
            from harness.play import play

            play(Path(command.play), command.gif, command.policy)
            return
        config = Config(**given)
        if command.resume is not None:
            saved = settings.load(Path(command.resume))
            config = settings.changed(saved, {**given, "out": command.resume})
        config = settings.complete(config)
        folder = Path(config.out).absolute()  # an environment may change the working folder
        try:
            train(config, resume=command.resume is not None)
        except STOPS as error:  # no fault of run.py's
            stopped(folder, error)
        except RuntimeError as error:  # PyTorch's MemoryErrors
            if "memory" not in str(error):
                raise
            stopped(folder, MemoryError("the memory is full"))
        print(
            f"{config.out}: curve.png, progress.csv; to see it: {records.to_type('--play', folder)}"
        )
    except (UsageError, EnvironmentFailed) as error:
        fail(str(error))
    except KeyboardInterrupt:  # while it plays
        sys.exit(130)


def stopped(folder: Path, error: BaseException) -> NoReturn:
    """Say why the run ended before its last epoch, and how to go on if there is anything to go on
    with."""
    done = records.epochs_done(folder)
    reason = f": {error}" if str(error) else ""
    saved = (folder / records.CHECKPOINT).exists()
    way_on = f"; to go on: {records.to_type('--resume', folder)}" if saved else ""
    print(f"run.py: stopped in epoch {done + 1}{reason}{way_on}", file=sys.stderr)
    sys.exit(130 if isinstance(error, KeyboardInterrupt) else 1)


def fail(message: str) -> NoReturn:
    """One line on stderr and exit code 2."""
    print(f"run.py: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(2)


def parse(argv: list[str] | None) -> tuple[dict, argparse.Namespace]:
    """The command line: the fields of Config that were given, and resume, play, gif and policy."""
    parser = argparse.ArgumentParser(
        prog="run.py",
        usage="python run.py [OPTION ...]",
        description="Train Value Consistency Prioritization, or play what it learned",
        allow_abbrev=False,
        add_help=False,
    )
    parser.error = fail
    do = parser.add_argument_group("what to do, but to train")
    do.add_argument("-h", "--help", action="help", help="show this and stop")
    do.add_argument("--resume", metavar="DIR", help="go on with the run in DIR")
    do.add_argument("--play", metavar="DIR", help="play what the run in DIR, or a policy, learned")
    do.add_argument("--gif", metavar="FILE", help="with --play: write an animation, no window")
    do.add_argument("--policy", metavar="FILE.npz", help="with --play: write the best head's")
    for f in fields(Config):
        if f.name in settings.GROUPS:
            group = parser.add_argument_group(settings.GROUPS[f.name])
        group.add_argument(
            settings.flag(f.name),
            type=settings.kind(f),
            choices=f.metadata["choices"],
            default=argparse.SUPPRESS,
            help=f.metadata["help"] + ("" if f.default is None else f" (default: {f.default})"),
        )
    with contextlib.suppress(AttributeError):  # 𝒯 on a terminal that is not UTF-8
        sys.stdout.reconfigure(errors="replace")
    given = vars(parser.parse_args(argv))
    names = ("resume", "play", "gif", "policy")
    command = argparse.Namespace(**{name: given.pop(name) for name in names})
    for name, value in vars(command).items():
        if value == "":
            fail(f"--{name} needs a name, and was given none")
    if command.resume and command.play:
        fail("--resume and --play do not go together")
    for name in given:
        if command.play or (command.resume and name == "out"):
            fail(
                f"{settings.flag(name)} does not go with {'--play' if command.play else '--resume'}"
            )
    for name in ("gif", "policy"):
        file = getattr(command, name)
        if file and not command.play:
            fail(f"--{name} goes with --play")
        if file and not Path(file).parent.is_dir():
            fail(f"--{name} {file}: there is no folder {Path(file).parent}")
    if command.gif and Path(command.gif).suffix.lower() not in ANIMATIONS:
        fail(f"--gif {command.gif}: its ending must be one of {', '.join(ANIMATIONS)}")
    if command.policy and Path(command.policy).suffix != ".npz":
        fail(f"--policy {command.policy}: its ending must be .npz")
    return given, command
