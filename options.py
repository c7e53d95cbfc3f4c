"""Every setting of a run, and the command line that sets them."""

import argparse
import importlib.util
import math
import sys
from dataclasses import Field, asdict, dataclass, field, fields
from pathlib import Path
from typing import NoReturn, get_args

import torch

import records
from envs_point import UsageError
from vcp import IMPORTANCE, PRIORITIES


def option(default, text, choices=None):
    """A setting that is an option of the command line too."""
    return field(default=default, metadata={"help": text, "choices": choices})


METHODS = ["vcp", "her", "herebp", "cher", "dtgsh"]


@dataclass
class Config:
    """Every setting of a run. NOTES.md says which of them the paper gives, and where."""

    env: str = option("FetchReach-v1", "the paper's name, the id of a goal environment, module:ID")
    method: str = option("vcp", "what decides what is replayed", METHODS)
    seed: int = option(0, "of everything that is random")
    out: str | None = option(None, "the run's folder (default: runs/<env>/<method>/seed<seed>)")
    # The schedule, Appendix B; None is filled in by `paper_schedule`
    epochs: int = option(50, "M in Algorithm 2")
    cycles: int | None = option(None, "n in Appendix B, collections an epoch: 5, 15 or 50 by env")
    updates: int | None = option(None, "updates of all heads in turn, a cycle: 5 or 40 by env")
    batch_size: int | None = option(None, "of one head's mini-batch: 64 or 256 by env")
    eval_episodes: int = option(160, "an epoch; rounded up to the same number for each head")
    # VCP, Section 4
    heads: int = option(16, "K: actors and critics")
    temperature: float = option(9.0, "𝒯 in Eq. (4); the paper takes one of 1, 5, 9, 11, 15")
    priority: str = option("consistency", "Eq. (4), or an ablation of Section 5.6", [*PRIORITIES])
    importance: str = option("paper", "w_i: Section 4.3, Schaul et al., or 1", [*IMPORTANCE])
    acting_head: str = option("all", "the heads that collect, Section 5.6", ["all", "one"])
    scored_per_drawn: float = option(1.0, "transitions Algorithm 1 scores for each one drawn")
    # The methods it is compared with
    faithful: bool = option(False, "herebp, cher, dtgsh with their released code's flaws: NOTES.md")
    # The machine
    device: str = option("auto", "for the networks; auto: a GPU if any", ["auto", "cpu", "cuda"])
    num_workers: int | None = option(None, "processes for the environments (default: one a core)")
    tensorboard: bool = option(False, "write the rows for TensorBoard too (needs tensorboard)")
    # HER and DDPG
    relabel_ratio: float = 0.8
    her_buffer_capacity: int | None = None  # of B_h, in transitions; None: what a cycle draws
    buffer_size: int = 1_000_000  # of B_o, in transitions
    learning_rate: float = 1e-3
    trunk_rate: float | None = None  # the shared trunks' share; None: `trunk_rate` below
    polyak: float = 0.95
    noise: float = 0.2  # standard deviation of the exploration noise; actions are in [-1, 1]
    random_actions: float = 0.3  # share of actions that are uniformly random
    action_penalty: float = 1.0


OF_VCP = (
    "temperature",
    "priority",
    "importance",
    "scored_per_drawn",
    "her_buffer_capacity",
)  # of no other method
MAY_CHANGE = ("epochs", "out", "device", "num_workers", "tensorboard")  # when a run is resumed


def paper_schedule(env: str, method: str = "vcp") -> dict[str, int]:
    """Appendix B's n and batch size. Not in the paper: the number of updates."""
    if method == "dtgsh":  # Appendix B: batch 64 everywhere, and as many transitions as the others
        schedule = paper_schedule(env)
        updates = schedule["updates"] * schedule["batch_size"] // 64
        return {**schedule, "batch_size": 64, "updates": updates}
    if env.startswith("FetchReach"):
        return {"cycles": 5, "updates": 5, "batch_size": 64}
    if env.startswith(("Reacher", "SparseReacher")):
        return {"cycles": 15, "updates": 5, "batch_size": 64}
    return {"cycles": 50, "updates": 40, "batch_size": 256}


def trunk_rate(updates: int, heads: int) -> float:
    """The trunks' share of the learning rate where none is given (not in the paper). With few
    updates a cycle, 1, Algorithm 2 to the letter: the trunks take K whole steps, one with each
    head. With many these K steps add up to one (NOTES.md, "The trunk's step")."""
    return 1.0 if updates <= 5 else 1 / heads


def her_buffer_capacity(config: Config) -> int:
    """Transitions that B_h holds, where none are given what a cycle draws (not in the paper; the
    released code's). UsageError if what Algorithm 1 scores at once is nothing or does not fit."""
    drawn, rate = config.batch_size * config.heads, config.scored_per_drawn  # by a sweep
    if not 1 / drawn <= rate < math.inf:
        raise UsageError(f"--scored-per-drawn must be {1 / drawn:g} or more here, not {rate}")
    scored = round(rate * drawn)
    capacity = config.her_buffer_capacity or max(drawn * config.updates, scored)
    if scored > capacity:
        raise UsageError(f"{scored} transitions are scored at once, and B_h holds {capacity}")
    return capacity


def complete(config: Config) -> Config:
    """A copy with schedule, device and folder filled in. UsageError for a setting out of range."""
    given = {name: value for name, value in asdict(config).items() if value is not None}
    config = Config(**{**paper_schedule(config.env, config.method), **given})
    for f in fields(config):
        value, choices = getattr(config, f.name), f.metadata.get("choices")
        if choices and value not in choices:
            raise UsageError(f"{flag(f.name)} must be one of {', '.join(choices)}, not {value!r}")
        if type(value) is int and value < 1 and f.name != "seed":
            raise UsageError(f"{flag(f.name)} must be 1 or more, not {value}")
    for name in OF_VCP if config.method != "vcp" else ():
        if getattr(config, name) != getattr(Config, name):
            raise UsageError(f"{flag(name)} goes with --method vcp, not with {config.method}")
    if config.faithful and config.method in ("vcp", "her"):
        raise UsageError(f"--faithful does not go with --method {config.method}")
    if config.method == "cher" and config.batch_size < 2:
        raise UsageError("--method cher selects from twice the batch: --batch-size 2 or more")
    if config.seed < 0:
        raise UsageError(f"--seed must be 0 or more, not {config.seed}")
    if not math.isfinite(config.temperature):
        raise UsageError(f"--temperature must be a finite number, not {config.temperature}")
    if config.method == "vcp":
        config.her_buffer_capacity = her_buffer_capacity(config)
    if config.trunk_rate is None:
        config.trunk_rate = trunk_rate(config.updates, config.heads)
    if config.device == "auto":
        config.device = "cuda" if torch.cuda.is_available() else "cpu"
    if config.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: no CUDA device was found")
    if config.tensorboard and importlib.util.find_spec("tensorboard") is None:
        raise UsageError("--tensorboard: the package is missing (pip install tensorboard)")
    config.out = config.out or f"runs/{config.env}/{config.method}/seed{config.seed}"
    return config


def load(folder: Path) -> Config:
    """The settings of the run in `folder`. UsageError if it holds none, or another version's."""
    try:
        return Config(**records.read_config(folder))
    except TypeError as error:
        raise UsageError(f"{folder} holds a run of another version ({error})") from error


def changed(saved: Config, given: dict) -> Config:
    """A saved run's settings with those that may change taken from `given`.
    UsageError if one that may not differs."""
    for name, value in given.items():
        if name not in MAY_CHANGE and getattr(saved, name) != value:
            was = getattr(saved, name)
            raise UsageError(f"the run was made with {flag(name)} {was}, not {value}")
    free = {name: value for name, value in given.items() if name in MAY_CHANGE}
    return Config(**{**asdict(saved), **free})


def flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def kind(f: Field) -> type:
    """bool, int, float or str, for a field of Config that may also be None."""
    return next(t for t in (bool, int, float, str) if t in (f.type, *get_args(f.type)))


def fail(message: str) -> NoReturn:
    """One line on stderr and exit code 2."""
    print(f"run.py: {message}", file=sys.stderr)
    sys.exit(2)


def parse(argv: list[str] | None) -> tuple[dict, argparse.Namespace]:
    """The command line: the fields of Config that were given, and resume, play and gif."""
    parser = argparse.ArgumentParser(
        prog="run.py", description="Train Value Consistency Prioritization, or play what it learned"
    )
    parser.error = fail
    parser.add_argument("--resume", metavar="DIR", help="go on with the run in DIR")
    parser.add_argument("--play", metavar="DIR", help="play episodes with what the run DIR learned")
    parser.add_argument("--gif", metavar="FILE", help="with --play: write an animation, no window")
    for f in fields(Config):
        if not f.metadata:
            continue
        text, keep_quiet = f.metadata["help"], argparse.SUPPRESS
        if f.type is bool:
            parser.add_argument(flag(f.name), action="store_true", default=keep_quiet, help=text)
        else:
            text += "" if f.default is None else f" (default: {f.default})"
            choices = f.metadata["choices"]
            parser.add_argument(
                flag(f.name), type=kind(f), choices=choices, default=keep_quiet, help=text
            )
    given = vars(parser.parse_args(argv))
    command = argparse.Namespace(**{name: given.pop(name) for name in ("resume", "play", "gif")})
    if command.resume and command.play:
        fail("--resume and --play do not go together")
    if command.gif and not command.play:
        fail("--gif goes with --play")
    return given, command
