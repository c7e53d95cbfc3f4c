"""Every setting of a run, the paper's schedule, and what is refused."""

import math
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_args

import torch

from harness import records
from harness.errors import UsageError
from harness.records import MAY_CHANGE
from vcp import IMPORTANCE, PRIORITIES

METHODS = ["vcp", "her", "herebp", "cher", "dtgsh"]
GROUPS = {  # headings of --help, each by the first setting below it
    "env": "the run",
    "epochs": "schedule, HER and DDPG",
    "heads": "VCP",
    "method": "comparisons and ablations",
    "device": "the machine",
}


def setting(default: Any, text: str, choices: Iterable[str] | None = None, **limits) -> Any:
    """A field of Config: what --help says of it, and the values it may have: one of `choices`,
    `least` or more, more than `above`, `most` or less."""
    choices = choices and [*choices]
    return field(default=default, metadata={"help": text, "choices": choices, "limits": limits})


@dataclass
class Config:
    """Every setting of a run. NOTES.md says which of them the paper gives, and where. A default of
    None is filled in, by `complete` or where the run's parts are made."""

    env: str = setting("FetchReach-v1", "the paper's name, a goal environment's id, or module:ID")
    seed: int = setting(0, "the run's random numbers follow from it", least=0, most=2**32 - 1)
    out: str | None = setting(None, "the run's folder (default: runs/ENV/VARIANT/seedSEED)")

    epochs: int = setting(50, "epochs, M in Algorithm 2", least=1)
    cycles: int | None = setting(None, "collections an epoch, n (default: 5, 15 or 50)", least=1)
    updates: int | None = setting(
        None, "updates of each head a cycle (default: 5 or 40; dtgsh: 5 or 160)", least=1
    )
    batch_size: int | None = setting(
        None, "transitions in a head's mini-batch (default: 64 or 256; dtgsh: 64)", least=1
    )
    episode_length: int | None = setting(
        None, "steps of an episode, T (default: 50, or the environment's own)", least=1
    )
    buffer_size: int = setting(1_000_000, "transitions that B_o holds", least=1)
    relabel_ratio: float = setting(0.8, "share of hindsight goals, k/(1+k)", least=0, most=1)
    learning_rate: float = setting(1e-3, "Adam's, of actors and critics", above=0)
    heads_at_once: int | None = setting(
        None, "heads that step together (default: 1, or all where updates are many)", least=1
    )
    polyak: float = setting(0.95, "what a target network keeps, a cycle", least=0, most=1)
    noise: float = setting(0.2, "standard deviation of the exploration noise", least=0)
    random_actions: float = setting(0.3, "share of uniformly random actions", least=0, most=1)
    action_penalty: float | None = setting(
        None, "weight of mean(μ²) in the actor's loss (default: 1, and 0.1 off the paper)", least=0
    )
    eval_episodes: int = setting(
        160, "test episodes an epoch, rounded up to as many for each head", least=1
    )

    heads: int = setting(16, "actors and critics, K", least=1)
    temperature: float = setting(
        9.0, "𝒯 in Eq. (4); the paper takes one of 1, 5, 9, 11, 15", least=0
    )
    importance: str = setting(
        "paper", "loss weights w_i: Section 4.3's, Schaul et al.'s, or all 1", IMPORTANCE
    )
    scored_per_drawn: float = setting(
        1.0, "transitions that Algorithm 1 scores for each one drawn", above=0
    )
    her_buffer_capacity: int | None = setting(
        None, "transitions that B_h holds (default: as many as a cycle draws)", least=1
    )

    method: str = setting("vcp", "the method that decides what is replayed", METHODS)
    priority: str = setting(
        "consistency",
        "Eq. (4), an ablation of Section 5.6, or Eq. (4) within each kind (not in the paper)",
        PRIORITIES,
    )
    acting_head: str = setting("all", "who collects episodes, Section 5.6", ["all", "one"])

    device: str = setting(
        "auto",
        "where the networks are; auto: a GPU, if any, where all heads step together, often",
        ["auto", "cpu", "cuda"],
    )
    threads: int | None = setting(
        None, "threads that train and score on the CPU (default: one a core)", least=1
    )
    num_workers: int | None = setting(
        None, "processes for the environments (default: one a core)", least=1
    )


FEW = 5  # updates a cycle
OF_VCP = ("temperature", "priority", "importance", "scored_per_drawn", "her_buffer_capacity")


def paper_schedule(env: str, method: str = "vcp") -> dict[str, int]:
    """Appendix B's n and batch size. Not in the paper: the number of updates."""
    env = without_package(env)
    if method == "dtgsh":  # Appendix B: batch 64 everywhere, and as many transitions as the others
        schedule = paper_schedule(env)
        updates = schedule["updates"] * schedule["batch_size"] // 64
        return {**schedule, "batch_size": 64, "updates": updates}
    if env.startswith("FetchReach"):
        return {"cycles": 5, "updates": 5, "batch_size": 64}
    if env.startswith(("Reacher", "SparseReacher")):
        return {"cycles": 15, "updates": 5, "batch_size": 64}
    return {"cycles": 50, "updates": 40, "batch_size": 256}


def without_package(env: str) -> str:
    """gymnasium_robotics:FetchReach-v4 and FetchReach-v4 are the same task."""
    return env.removeprefix("gymnasium_robotics:")


def action_penalty(env: str) -> float:
    """HER's 1 for the paper's tasks, by the beginning of their names. Others do better with a tenth
    of it (not in the paper; docs/environments.md has the runs)."""
    paper = ("Fetch", "Hand", "PointMass", "Reacher", "SparseReacher")
    return 1.0 if without_package(env).startswith(paper) else 0.1


def heads_at_once(updates: int, heads: int) -> int:
    """How many heads take a step together where it is not given (not in the paper). With few
    updates a cycle one, Algorithm 2 to the letter: the trunks take K steps, one with each head.
    With many, all, so that the trunks take one (NOTES.md, "Heads in turn or at once")."""
    return 1 if updates <= FEW else heads


def drawn_a_sweep(config: Config) -> int:
    """Transitions that one update of all heads draws."""
    return config.batch_size * config.heads


def scored_a_sweep(config: Config) -> int:
    """Transitions that Algorithm 1 scores meanwhile."""
    return round(config.scored_per_drawn * drawn_a_sweep(config))


def complete(config: Config) -> Config:
    """A copy with all that is None by default filled in, but for what the run's parts decide.
    UsageError for a setting of the wrong type, out of range, of another method, or of no effect."""
    given = {name: value for name, value in asdict(config).items() if value is not None}
    for f in fields(Config):
        if f.name in given:
            given[f.name] = checked(f, given[f.name])
    method = given.get("method", "vcp")
    config = Config(**{**paper_schedule(given.get("env", Config.env), method), **given})
    for name in OF_VCP if method != "vcp" else ():
        if getattr(config, name) != getattr(Config, name):
            raise UsageError(f"{flag(name)} goes with --method vcp, not with {method}")
    for name in ("temperature", "importance") if config.priority == "uniform" else ():
        if getattr(config, name) != getattr(Config, name):
            raise UsageError(f"{flag(name)} changes nothing with --priority uniform")
    if method == "cher" and config.batch_size < 2:
        raise UsageError("--method cher selects from twice the batch: --batch-size 2 or more")
    if method == "vcp":
        scored, drawn = scored_a_sweep(config), drawn_a_sweep(config)
        if not scored:
            raise UsageError(f"--scored-per-drawn must be {1 / drawn:g} or more to score anything")
        # B_h holds what a cycle draws (not in the paper; the released code's).
        capacity = config.her_buffer_capacity or max(drawn * config.updates, scored)
        if scored > capacity:
            raise UsageError(f"{scored} transitions are scored at once, and B_h holds {capacity}")
        config.her_buffer_capacity = capacity
    if config.action_penalty is None:
        config.action_penalty = action_penalty(config.env)
    if config.heads_at_once is None:
        config.heads_at_once = heads_at_once(config.updates, config.heads)
    if config.heads % config.heads_at_once:
        raise UsageError(f"--heads-at-once must divide the {config.heads} heads")
    if config.device == "auto":
        # Heads in turn are many small calls, which a GPU hardly makes faster (results/SPEED.md);
        # where updates are few, most of the time goes into collecting.
        much = config.heads_at_once == config.heads and config.updates > FEW
        config.device = "cuda" if much and torch.cuda.is_available() else "cpu"
    if config.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: no CUDA device was found")
    if config.out is None:
        config.out = f"runs/{default_folder(config)}"
    return config


def checked(f, value: Any) -> Any:
    """The value of a field of Config, in its type. UsageError for another type or range."""
    what, wanted, limits = flag(f.name), kind(f), f.metadata["limits"]
    if wanted is float and type(value) is int:
        value = float(value)
    if type(value) is not wanted:
        raise UsageError(f"{what} must be of type {wanted.__name__}, not {value!r}")
    if f.metadata["choices"] and value not in f.metadata["choices"]:
        raise UsageError(f"{what} must be one of {', '.join(f.metadata['choices'])}, not {value!r}")
    if wanted is float and not math.isfinite(value):
        raise UsageError(f"{what} must be a finite number, not {value}")
    if "least" in limits and value < limits["least"]:
        raise UsageError(f"{what} must be {limits['least']} or more, not {value}")
    if "above" in limits and value <= limits["above"]:
        raise UsageError(f"{what} must be above {limits['above']}, not {value}")
    if "most" in limits and value > limits["most"]:
        raise UsageError(f"{what} must be {limits['most']} or less, not {value}")
    return value


def differences(config: Config) -> dict[str, Any]:
    """The settings of a complete Config that its environment and method alone would not give, but
    for the seed and what may change when it is resumed."""
    default = complete(Config(env=config.env, method=config.method, out=""))
    follows = complete(replace(config, heads_at_once=None, her_buffer_capacity=None, out=""))
    for name in ("heads_at_once", "her_buffer_capacity"):  # which follow from other settings
        setattr(default, name, getattr(follows, name))
    names = [f.name for f in fields(Config) if f.name not in ("seed", *MAY_CHANGE)]
    pairs = {name: (getattr(config, name), getattr(default, name)) for name in names}
    return {name: value for name, (value, usual) in pairs.items() if value != usual}


def variant(config: Config) -> str:
    """What a run is called: its method, and each setting that differs."""
    parts = [f"{name}-{value}" for name, value in differences(config).items()]
    return "_".join([config.method, *parts])


def default_folder(config: Config) -> str:
    """Where below runs/ the run is."""
    env = re.sub(r"[^\w.-]+", "-", config.env)  # Windows refuses a colon
    return f"{env}/{variant(config)}/seed{config.seed}"


def load(folder: Path) -> Config:
    """The settings of the run in `folder`. UsageError if it holds none, or another version's."""
    try:
        saved = records.read_config(folder)
        # settings that are gone, and whose False changed nothing
        older = {name for name in ("faithful", "tensorboard") if saved.get(name) is False}
        return Config(**{name: value for name, value in saved.items() if name not in older})
    except (TypeError, AttributeError) as error:
        raise UsageError(f"{folder} holds a run of another version ({error})") from error


def changed(saved: Config, given: dict[str, Any]) -> Config:
    """A saved run's settings with those that may change taken from `given`.
    UsageError if one that may not differs."""
    for name, value in given.items():
        if name not in MAY_CHANGE and getattr(saved, name) != value:
            was = getattr(saved, name)
            raise UsageError(f"the run was made with {flag(name)} {was}, not {value}")
    return replace(saved, **{name: given[name] for name in MAY_CHANGE if name in given})


def flag(name: str) -> str:
    """The option of a field: batch_size -> --batch-size."""
    return "--" + name.replace("_", "-")


def kind(f) -> type:
    """int, float or str, for a field of Config that may also be None."""
    return next(t for t in (int, float, str) if t in (f.type, *get_args(f.type)))
