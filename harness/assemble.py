"""A run's parts, made from its settings: Algorithm 2, line 1."""

import math
import os
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from baselines import cher, dtgsh, herebp
from baselines.her import HERReplay
from ensemble import HIDDEN, PART, EnsembleDDPG
from harness import records, settings
from harness.border import Border
from harness.errors import UsageError
from harness.gpu import EnsembleOnGPU, HERBufferOnGPU
from harness.settings import Config
from harness.tasks import before_training, examine, make_env
from harness.workers import ParallelEnvs, available_cores, number_of_workers
from her import EpisodeBuffer
from vcp import HERBuffer


def memory() -> int:
    """The bytes that this process may take: the least of what the machine has, of a container's
    limit (cgroup) and of what `ulimit -v` leaves; sys.maxsize where none can be asked for."""
    limits = [sys.maxsize]
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    with suppress(OSError, ValueError):  # no Linux, or no limit
        group = Path("/proc/self/cgroup").read_text().splitlines()[-1].rpartition(":")[2]
        folder = Path("/sys/fs/cgroup", group.lstrip("/"))
        for place in (folder, *folder.parents):
            for file in (place / "memory.max", place / "memory" / "memory.limit_in_bytes"):
                with suppress(OSError, ValueError):
                    limits.append(int(file.read_text()))
    with suppress(ImportError, OSError, ValueError):
        import resource

        (limit, _), pages = resource.getrlimit(resource.RLIMIT_AS), 0
        if limit != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            limits.append(limit - pages * resource.getpagesize())
    return max(min(limits), 0)


@dataclass
class Parts:
    """What `run.train` works with."""

    config: Config
    task: Border
    num_envs: int
    agent: EnsembleDDPG  # 𝔸
    original_buffer: EpisodeBuffer  # B_o
    her_buffer: HERBuffer | None  # B_h; another method has none
    replay: HERBuffer | HERReplay  # what line 15 draws from: B_h, or another method's

    def state(self) -> dict:
        """What a checkpoint keeps."""
        episodes = self.original_buffer.episodes
        agent, replay = self.agent.state_dict(), self.replay.state_dict()
        return {"agent": agent, "episodes": episodes, "replay": replay}

    def load_state(self, state: dict) -> None:
        """Take over a `state` of parts of the same sizes."""
        self.agent.load_state_dict(state["agent"])
        self.original_buffer.size = 0  # so nothing is overwritten, and nothing random is drawn
        self.original_buffer.add(state["episodes"], np.random.default_rng(0))
        self.replay.load_state_dict(state["replay"])

    def threads(self) -> int:
        """How many compute beside each other. Heads that take turns are trained in the main thread,
        which leaves one core fewer for the rest."""
        threads = self.config.threads or len(available_cores())
        return threads if self.config.heads_at_once > 1 else max(threads - 1, 1)

    @contextmanager
    def envs(self) -> Iterator[ParallelEnvs]:
        """The environments, in their processes. Afterwards the one of the task is closed too."""
        config, workers = self.config, number_of_workers(self.config.num_workers, self.num_envs)
        # each half has the environments of whole heads, or of the only one
        halves = workers % 2 == 0 and (config.heads % 2 == 0 or config.heads == 1)
        with closing(self.task):
            with before_training():
                parallel = ParallelEnvs(
                    config.env, self.num_envs, workers, halves, episode_length=config.episode_length
                )
            with parallel as envs:
                yield envs


def memory_needed(config: Config, task: Border) -> int:
    """Bytes that networks, buffers and a mini-batch of a run take when they are full, roughly."""
    # a transition of B_h, and of a mini-batch
    row = 4 * (2 * task.obs_dim + task.goal_dim + task.action_dim + 4)
    of_a_head = 4 * HIDDEN * (HIDDEN + 2 + task.action_dim)
    networks = 9 * config.heads * of_a_head  # two, with targets and moments, and a copy of one
    # of all heads, as if all threads were at the end of a pass at once
    hidden = 16 * HIDDEN * config.heads * max(config.batch_size, PART)
    # B_o, and what is being collected, twice
    steps = config.buffer_size + 2 * number_of_envs(config) * task.horizon
    b_o = 4 * steps * (task.obs_dim + task.goal_dim + task.action_dim)
    return networks + hidden + b_o + row * ((config.her_buffer_capacity or 0) + config.batch_size)


def number_of_envs(config: Config) -> int:
    """One a head; fewer than 16 heads have several each, for the paper's amount of data."""
    return config.heads * math.ceil(16 / config.heads)


def refuse_what_does_not_fit(config: Config, task: Border) -> None:
    """UsageError for sizes that the memory or B_o does not hold."""
    needed, there = memory_needed(config, task), memory()
    if needed > there:
        sizes = "--heads, --batch-size, --buffer-size or --episode-length"
        amount = f"{needed / 2**30:.1f} GB are needed and {there / 2**30:.1f} are there"
        raise UsageError(f"{amount}: lower {sizes}")
    num_envs = number_of_envs(config)
    if num_envs > config.buffer_size // task.horizon:
        raise UsageError(f"--buffer-size must hold {num_envs} episodes of {task.horizon} steps")


@before_training()
def assemble(config: Config) -> Parts:
    """All parts of a run, untrained. config: complete. UsageError for an environment that cannot be
    learned in, and for sizes that the memory does not hold."""
    task = examine(config.env, config.episode_length, partial(refuse_what_does_not_fit, config))
    if config.action_penalty != 1:
        penalty = f"action penalty {config.action_penalty:g} (1 is HER's, for the paper's tasks)"
        task.made += f"; {penalty}"
    num_envs = number_of_envs(config)
    agent = make_agent(config, task)
    original_buffer = EpisodeBuffer(
        config.buffer_size,
        task.horizon,
        task.obs_dim,
        task.goal_dim,
        task.action_dim,
        config.relabel_ratio,
        task.compute_reward,
    )
    replay = make_replay(config, task, original_buffer)
    her_buffer = replay if config.method == "vcp" else None
    return Parts(config, task, num_envs, agent, original_buffer, her_buffer, replay)


def make_agent(config: Config, task: Border) -> EnsembleDDPG:
    """The off-policy algorithm 𝔸, with the networks' sizes for the task."""
    ensemble = EnsembleOnGPU if config.device == "cuda" else EnsembleDDPG
    return ensemble(
        obs_dim=task.obs_dim,
        goal_dim=task.goal_dim,
        action_dim=task.action_dim,
        num_heads=config.heads,
        gamma=1 - 1 / task.horizon,
        learning_rate=config.learning_rate,
        polyak=config.polyak,
        action_penalty=config.action_penalty,
        device=config.device,
        seed=config.seed,
    )


def make_replay(
    config: Config, task: Border, original_buffer: EpisodeBuffer
) -> HERBuffer | HERReplay:
    """What Algorithm 2, line 15, draws from: B_h, or the replay of another method."""
    if config.method == "vcp":
        b_h = HERBuffer
        if config.device == "cuda":
            b_h = partial(HERBufferOnGPU, at_once=config.heads, device=config.device)
        return b_h(
            capacity=config.her_buffer_capacity,
            temperature=config.temperature,
            priority=config.priority,
            importance=config.importance,
        )
    drawn = config.updates * config.heads  # mini-batches in a cycle
    at_once = max(n for n in range(1, 41) if drawn % n == 0)
    if config.method == "her":
        return HERReplay(original_buffer, at_once=at_once)
    common = {"env_name": settings.without_package(config.env), "at_once": at_once}
    if config.method == "herebp":
        return herebp.HEREBP(original_buffer, **common, dt=task.dt)
    if config.method == "cher":
        updates = config.cycles * config.updates
        return cher.CHER(original_buffer, **common, heads=config.heads, updates=updates)
    return dtgsh.DTGSH(original_buffer, **common)


def restored(folder: Path) -> tuple[Parts, list[dict]]:
    """The parts of the run in `folder` after its last whole epoch, and its rows, on the CPU, also
    of a run from a GPU. UsageError if there is none."""
    config = replace(settings.load(folder), device="cpu")
    parts = assemble(settings.complete(config))
    rows = records.restore(folder, asdict(parts.config), parts)
    if not rows:
        raise UsageError(f"the run in {folder} has no whole epoch yet")
    return parts, rows


def load(folder: str | Path, **kwargs) -> tuple[EnsembleDDPG, Border]:
    """The trained agent of the run in `folder`, and its environment; kwargs, such as render_mode,
    go to the latter. UsageError if there is none."""
    parts, _ = restored(Path(folder))
    return parts.agent, make_env(parts.config.env, parts.config.episode_length, **kwargs)
