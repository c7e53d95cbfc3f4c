"""Many runs: environments x variants x seeds, on this machine or a Ray cluster.

    python -m experiments.sweep --env FetchReach-v1 Reacher-v2 --seeds 0-4 \\
        --variants "" priority=uniform method=her,heads=1 --set epochs=20

A variant is a list of settings (the fields of harness.settings.Config), "" the defaults; --set goes
for all runs. A run is in OUT/<env>/<its method and what differs>/seed<s>. Finished ones are skipped
and broken ones resumed, so the same command goes on where it was stopped.

    python -m experiments.sweep --plan experiments/paper.txt

trains the runs of a file, whose lines are such arguments, one after the other in its order, without
Ray. Several such commands, on machines that share the folder, each take the next run that is free.
"""

import argparse
import os
import shlex
import signal
import sys
import traceback
from dataclasses import asdict, fields
from pathlib import Path

from tqdm import tqdm

import run
from harness import records
from harness import settings as options
from harness.errors import FolderInUse, UsageError
from harness.settings import Config
from harness.tasks import make_env

ROOT = Path(__file__).parent.parent
TYPES = {f.name: options.kind(f) for f in fields(Config) if f.name not in ("env", "seed", "out")}


def settings(text: str) -> dict:
    """ "method=her,heads=1" -> {"method": "her", "heads": 1}. UsageError for what is no setting."""
    given = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.partition("=")
        if name not in TYPES:
            raise UsageError(f"{name} is no setting; they are {', '.join(TYPES)}")
        try:
            given[name] = TYPES[name](value)
        except ValueError as error:
            raise UsageError(f"{part}: not of type {TYPES[name].__name__}") from error
    return given


def seeds(text: str) -> list[int]:
    """ "0-2,7" -> [0, 1, 2, 7]."""
    ends = [[int(end) for end in part.split("-")] for part in text.split(",")]
    seeds = [seed for part in ends for seed in range(part[0], part[-1] + 1)]
    if not seeds:
        raise argparse.ArgumentTypeError(f"{text} holds no seed")
    return seeds


def all_runs(which: argparse.Namespace, given: argparse.Namespace) -> list[Config]:
    """The configs of what WHICH parsed, seeds last, so that the first of each is done before the
    second of any. UsageError if one of them cannot be run."""
    common = {"num_workers": given.cores, "threads": given.cores, **settings(which.set)}
    runs = []
    for seed in which.seeds:
        for env in which.env:
            for variant in which.variants:
                config = Config(**{**common, **settings(variant)}, env=env, seed=seed, out="")
                config = options.complete(config)
                config.out = str(Path(given.out, options.default_folder(config)))
                runs.append(config)
    if len({config.out for config in runs}) < len(runs):
        raise UsageError(f"two runs are the same: {' '.join(which.variants)}")
    return runs


def planned(file: Path, given: argparse.Namespace) -> list[Config]:
    """The configs of a plan, in its order. A run may come again with more epochs. UsageError, with
    the line's number, for one that is no list of arguments or cannot be run."""
    try:
        lines = file.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read {file}: {error}") from error
    parser = argparse.ArgumentParser(add_help=False, exit_on_error=False, parents=[WHICH])
    runs = []
    for number, line in enumerate(lines, 1):
        try:
            if arguments := shlex.split(line, comments=True):
                which, unknown = parser.parse_known_args(arguments)
                if unknown or not which.env:
                    raise UsageError(f"unknown: {' '.join(unknown)}" if unknown else "no --env")
                runs += all_runs(which, given)
        except (argparse.ArgumentError, ValueError) as error:
            raise UsageError(f"{file}, line {number}: {error}") from error
    return runs


def train_one(config: Config, here: str = ".") -> None:
    """Start the run, or go on with it if it was broken off. If it fails, error.txt in its folder
    says why. UsageError if the folder holds a run with other settings. here: what a relative folder
    is relative to, also after an environment has changed the working folder."""
    os.chdir(here)
    folder = Path(config.out).absolute()
    resume = (folder / "config.json").exists()
    note = folder / "error.txt"
    try:
        if resume:
            config = options.changed(options.load(folder), asdict(config))
        run.train(config, resume=resume)
        note.unlink(missing_ok=True)
    except FolderInUse:
        raise
    except Exception as error:
        if isinstance(error, UsageError) and not resume and (folder / "config.json").exists():
            raise FolderInUse(f"another process was the first in {folder}") from error
        folder.mkdir(parents=True, exist_ok=True)
        note.write_text(traceback.format_exc())
        raise
    finally:
        os.chdir(here)


def in_order(runs: list[Config]) -> dict:
    """Train the runs one after the other, in this process, and pass over those that another one
    trains. The errors of those that failed, by folder."""
    failed = {}
    for config in runs:
        if epochs_done(config) >= config.epochs or config.out in failed:
            continue
        print(f"{whole(runs)}, now {config.out}, {epochs_done(config)} of {config.epochs} epochs")
        sys.stdout.flush()
        try:
            train_one(config, os.getcwd())
        except FolderInUse as error:
            print(error)
        except Exception as error:  # the others can be trained
            failed[config.out] = f"{type(error).__name__}: {error}"
    return failed


def in_ray(runs: list[Config], cores: float, gpus: float, address: str | None) -> dict:
    """Train all of them as tasks of Ray, which tries again what is lost with its worker. The errors
    of those that failed, by folder."""
    try:
        import ray
    except ModuleNotFoundError:
        sys.exit("sweep.py: Ray is missing: pip install -r requirements-experiments.txt, or --plan")

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # it would report to its makers
    ray.init(
        address=address,
        log_to_driver=False,
        include_dashboard=False,
        runtime_env={"env_vars": {"PYTHONPATH": str(ROOT)}},
    )
    task = ray.remote(num_cpus=cores, num_gpus=gpus, max_retries=3)(train_one)
    waiting = {task.remote(config, os.getcwd()): config for config in runs}
    failed = {}
    with tqdm(total=sum(config.epochs for config in runs), unit="epoch") as bar:
        while waiting:
            ready, _ = ray.wait(list(waiting), timeout=1)
            for done in ready:
                folder = waiting.pop(done).out
                try:
                    ray.get(done)
                except ray.exceptions.RayError as error:
                    failed[folder] = str(error).strip().splitlines()[-1]
            bar.n = sum(epochs_done(config) for config in runs)
            bar.set_postfix(left=len(waiting), failed=len(failed))
    ray.shutdown()
    return failed


class Stopped(BaseException):
    """By a signal. Not SystemExit, which an environment may raise too; nor KeyboardInterrupt: where
    one passes through exec(text), as in many an import, CPython kills `python -m` with SIGINT."""


def stop(*_) -> None:
    raise Stopped


def epochs_done(config: Config) -> int:
    return records.epochs_done(Path(config.out))


def whole(runs: list[Config]) -> str:
    done = sum(epochs_done(config) >= config.epochs for config in runs)
    return f"{done} of {len(runs)} runs are whole"


WHICH = argparse.ArgumentParser(add_help=False)  # the runs: arguments, and lines of a plan
WHICH.add_argument("--env", nargs="+", help="one or more, as for run.py")
WHICH.add_argument(
    "--variants",
    nargs="+",
    default=[""],
    metavar="NAME=VALUE,...",
    help='one or more, each the settings that differ; "" is run.py\'s defaults (default: "")',
)
WHICH.add_argument("--set", default="", metavar="NAME=VALUE,...", help="for all runs")
WHICH.add_argument("--seeds", type=seeds, default=[0], help="such as 0-4 or 0,3 (default: 0)")


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="sweep.py", description=__doc__.split("\n")[0], parents=[WHICH]
    )
    parser.add_argument("--plan", metavar="FILE", help="in place of --env: lines of the above")
    parser.add_argument("--out", default="runs", help="default: runs")
    parser.add_argument("--cores", type=int, default=1, help="of each run (default: 1)")
    parser.add_argument("--gpus", type=float, default=0, help="share of each run (default: 0)")
    parser.add_argument("--address", help="of a Ray cluster (default: Ray on this machine)")
    parser.add_argument("--list", action="store_true", help="print the runs and stop")
    given = parser.parse_args(argv)
    try:
        if bool(given.plan) == bool(given.env):
            raise UsageError("one of --env and --plan is needed")
        for name in ("variants", "set", "seeds", "gpus", "address") if given.plan else ():
            if getattr(given, name) != parser.get_default(name):
                raise UsageError(f"--{name} does not go with --plan")
        here = os.getcwd()
        runs = planned(Path(given.plan), given) if given.plan else all_runs(given, given)
        for env, length in dict.fromkeys((config.env, config.episode_length) for config in runs):
            make_env(env, length).close()  # UsageError for one that cannot be learned in
        os.chdir(here)  # which an environment may have changed
    except UsageError as error:
        parser.error(str(error))
    if given.list:
        for i, config in enumerate(runs):
            print(f"{i:4} {epochs_done(config):4} of {config.epochs} epochs  {config.out}")
        print(whole(runs), file=sys.stderr)
        return
    left = [config for config in runs if epochs_done(config) < config.epochs]
    if given.plan:
        failed = in_order(runs)
    else:
        failed = in_ray(left, given.cores, given.gpus, given.address) if left else {}
    print(whole(runs))
    for folder, error in failed.items():
        print(f"FAILED {folder}: {error} (error.txt there)")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    try:
        main()
    except Stopped:
        sys.exit("sweep.py: stopped; the same command goes on")
