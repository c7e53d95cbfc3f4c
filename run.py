"""Algorithm 2, the VCP algorithm, line by line, and its command line.

    python run.py --env FetchReach-v1

`train` is the algorithm and `Config` holds every hyper-parameter.

Letters in the shape comments:
    K heads    N environments    T steps of an episode    O observation    G goal    A action
"""

import argparse
import math
import sys
import time
from collections import defaultdict
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import NoReturn, get_args

import numpy as np
import torch
from tqdm import tqdm

import records
from ensemble import EnsembleDDPG
from envs_point import UsageError, describe, make_env
from her import EpisodeBuffer, relabel_future
from vcp import IMPORTANCE, PRIORITIES, HERBuffer, in_thread, update_her_buffer
from workers import ParallelEnvs, one_torch_thread

tqdm.monitor_interval = 0  # its watching thread would outlive a run


def option(default, text, choices=None):
    """A setting that is an option of the command line too."""
    return field(default=default, metadata={"help": text, "choices": choices})


@dataclass
class Config:
    """Every setting of a run. NOTES.md says which of them the paper gives, and where."""

    env: str = option("FetchReach-v1", "the paper's name, the id of a goal environment, module:ID")
    method: str = option("vcp", "what to train", ["vcp"])
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
    her_thread: bool = option(False, "Algorithm 1 in a thread, as in the paper; not reproducible")
    # The machine
    device: str = option("auto", "for the networks; auto: a GPU if any", ["auto", "cpu", "cuda"])
    num_workers: int | None = option(None, "processes for the environments (default: one a core)")
    # HER and DDPG
    relabel_ratio: float = 0.8
    scored_per_update: int | None = None  # mini-batches through Algorithm 1 for one of all heads
    buffer_size: int = 1_000_000  # of B_o, in transitions
    learning_rate: float = 1e-3
    polyak: float = 0.95
    noise: float = 0.2  # standard deviation of the exploration noise; actions are in [-1, 1]
    random_actions: float = 0.3  # share of actions that are uniformly random
    action_penalty: float = 1.0


def paper_schedule(env: str) -> dict[str, int]:
    """Appendix B's n and batch size. Not in the paper: the number of updates, and how many
    mini-batches Algorithm 1 scores for one update of all heads."""
    if env.startswith("FetchReach"):
        return {"cycles": 5, "updates": 5, "batch_size": 64, "scored_per_update": 4}
    if env.startswith(("Reacher", "SparseReacher")):
        return {"cycles": 15, "updates": 5, "batch_size": 64, "scored_per_update": 4}
    return {"cycles": 50, "updates": 40, "batch_size": 256, "scored_per_update": 1}


def complete(config: Config) -> Config:
    """A copy with schedule, device and folder filled in. UsageError for a setting out of range."""
    given = {name: value for name, value in asdict(config).items() if value is not None}
    config = Config(**{**paper_schedule(config.env), **given})
    for f in fields(config):
        value, flag = getattr(config, f.name), "--" + f.name.replace("_", "-")
        choices = f.metadata.get("choices")
        if choices and value not in choices:
            raise UsageError(f"{flag} must be one of {', '.join(choices)}, not {value!r}")
        if isinstance(value, int) and value < 1 and f.name not in ("seed", "her_thread"):
            raise UsageError(f"{flag} must be 1 or more, not {value}")
    if config.seed < 0:
        raise UsageError(f"--seed must be 0 or more, not {config.seed}")
    if not math.isfinite(config.temperature):
        raise UsageError(f"--temperature must be a finite number, not {config.temperature}")
    if config.device == "auto":
        config.device = "cuda" if torch.cuda.is_available() else "cpu"
    if config.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("--device cuda: no CUDA device was found")
    config.out = config.out or f"runs/{config.env}/{config.method}/seed{config.seed}"
    return config


def play(envs: ParallelEnvs, policy, horizon: int) -> tuple[dict, np.ndarray]:
    """Algorithm 2, lines 4-11: an episode in each environment, all at once.

    policy: (N, O) observations and (N, G) goals -> (N, A) actions in [-1, 1].
    Gives the episodes, with the arrays of her.EpisodeBuffer, and is_success at the last step, (N,).
    """
    steps, actions = [envs.reset()], []  # line 5
    goal = steps[0]["desired_goal"]
    with one_torch_thread():
        for _ in range(horizon):  # line 6
            actions.append(np.float32(policy(steps[-1]["observation"], goal)))  # line 7
            obs, success = envs.step(actions[-1])  # line 8
            steps.append(obs)
    episodes = {
        "obs": np.stack([obs["observation"] for obs in steps], axis=1),  # (N, T+1, O)
        "achieved_goal": np.stack([obs["achieved_goal"] for obs in steps], axis=1),  # (N, T+1, G)
        "desired_goal": goal,  # (N, G)
        "action": np.stack(actions, axis=1),  # (N, T, A)
    }
    for name, array in episodes.items():
        if not np.isfinite(array).all():
            raise FloatingPointError(f"NaN or Inf in the {name} of an episode")
    return episodes, success


def by_head(rows: np.ndarray, heads: int) -> np.ndarray:
    """(N, ..., D) -> (heads, -1, D): the first N/heads environments are head 0's, and so on."""
    return rows.reshape(heads, -1, rows.shape[-1])


def act(agent: EnsembleDDPG, obs: np.ndarray, goal: np.ndarray, heads: int) -> np.ndarray:
    """Actions without noise of the first `heads` heads, which share the N environments evenly."""
    action = agent.act(by_head(obs, heads), by_head(goal, heads), slice(heads))
    return action.reshape(len(obs), -1)


def explore(action: np.ndarray, rng: np.random.Generator, noise: float, random_actions: float):
    """HER's exploration (not in the paper): Gaussian noise, then some actions uniform instead.
    action (N, A), and what it gives, in [-1, 1]."""
    noisy = np.clip(action + noise * rng.standard_normal(action.shape), -1, 1)
    uniform = rng.uniform(-1, 1, action.shape)
    return np.where(rng.random((len(action), 1)) < random_actions, uniform, noisy)


def evaluate(envs, agent: EnsembleDDPG, heads: int, horizon: int, rounds: int, bar) -> dict:
    """Section 5.1: `rounds` episodes in each environment, by all heads, without noise. The success
    rate, and the mean of Q_k(s, μ_k(s, g), g) over all steps."""
    successes, q = [], []
    for _ in range(rounds):
        episodes, success = play(envs, lambda obs, goal: act(agent, obs, goal, heads), horizon)
        obs = episodes["obs"][:, :-1]  # (N, T, O)
        goal = np.repeat(episodes["desired_goal"][:, None], horizon, axis=1)  # (N, T, G)
        q.append(agent.value(by_head(obs, heads), by_head(goal, heads)))
        successes.append(success)
        bar.update()
    return {"test_success_rate": float(np.mean(successes)), "test_q": float(np.mean(q))}


def variance_by_kind(agent: EnsembleDDPG, her_buffer: HERBuffer, most: int = 4096) -> dict:
    """Figure 4: the mean variance of the critics NOW on the hindsight and the original transitions
    of B_h, from at most about `most` of them, evenly spread."""
    every = slice(None, her_buffer.size, max(1, her_buffer.size // most))
    rows = {name: x[every] for name, x in her_buffer.data.items()}
    variance = agent.q_variance(rows["obs"], rows["action"], rows["goal"])
    kinds = {"hindsight": rows["hindsight"], "original": ~rows["hindsight"]}
    return {
        f"variance_{name}": float(variance[kind].mean()) if kind.any() else math.nan
        for name, kind in kinds.items()
    }


@contextmanager
def timed(seconds: dict[str, float], name: str):
    """Add the wall time of the block to seconds[name]."""
    start = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - start


def train(config: Config) -> list[dict]:
    """Algorithm 2. Writes the run's folder and gives the rows of its progress.csv.

    Everything random follows from (seed, epoch). UsageError, before anything is written, for a
    config that cannot be run; FloatingPointError where NaN or Inf turns up.
    """
    config = complete(config)
    env = make_env(config.env)
    env.close()
    obs_dim = env.observation_space["observation"].shape[0]
    goal_dim = env.observation_space["desired_goal"].shape[0]
    action_dim = env.action_space.shape[0]
    horizon = env.spec.max_episode_steps  # T
    heads, batch_size = config.heads, config.batch_size
    # One environment a head; fewer than 16 heads have several each, for the paper's amount of data.
    num_envs = heads * math.ceil(16 / heads)
    test_rounds = math.ceil(config.eval_episodes / num_envs)

    # Line 1: the off-policy algorithm 𝔸, B_o and B_h
    agent = EnsembleDDPG(
        obs_dim,
        goal_dim,
        action_dim,
        heads=heads,
        gamma=1 - 1 / horizon,
        learning_rate=config.learning_rate,
        polyak=config.polyak,
        action_penalty=config.action_penalty,
        device=config.device,
        seed=config.seed,
    )
    original_buffer = EpisodeBuffer(config.buffer_size, horizon, obs_dim, goal_dim, action_dim)
    her_buffer = HERBuffer(
        capacity=batch_size * config.updates * heads,  # what a cycle draws
        temperature=config.temperature,
        priority=config.priority,
        importance=config.importance,
    )

    def reward_fn(achieved, desired):
        return env.unwrapped.compute_reward(achieved, desired, {})  # Eq. (1)

    def collect(random_actions):  # lines 3-11
        acting = heads if config.acting_head == "all" else 1
        episodes, success = play(
            envs,
            lambda obs, goal: explore(
                act(agent, obs, goal, acting), play_rng, config.noise, random_actions
            ),
            horizon,
        )
        original_buffer.add(episodes, play_rng)  # line 9
        # The normaliser sees what the networks will: relabelled goals too.
        size = num_envs * horizon
        seen = relabel_future(episodes, size, play_rng, config.relabel_ratio, reward_fn)
        agent.normalizer.update(np.concatenate([seen["obs"], seen["goal"]], axis=1))
        return success

    def algorithm_1():  # its lines 3-7
        size = batch_size * config.scored_per_update
        ratio = config.relabel_ratio
        update_her_buffer(original_buffer, her_buffer, agent, size, her_rng, ratio, reward_fn)

    folder, rows, env_steps, start = Path(config.out), [], 0, time.perf_counter()
    with ParallelEnvs(config.env, num_envs, config.num_workers) as envs:
        records.start(folder, asdict(config))
        print(describe(config.env))
        for epoch in range(1, config.epochs + 1):  # line 2
            seeds = np.random.SeedSequence([config.seed, epoch])
            train_seed, test_seed = map(int, seeds.generate_state(2))
            play_rng, her_rng, draw_rng = map(np.random.default_rng, seeds.spawn(3))
            seconds, successes, losses, originals = defaultdict(float), [], [], []
            rounds = config.cycles + test_rounds
            bar = tqdm(desc=f"epoch {epoch}", total=rounds, leave=False, disable=None)

            envs.reset(train_seed)
            if epoch == 1:  # not in the paper: first an episode of random actions in each
                collect(random_actions=1)
                env_steps += num_envs * horizon
            for _ in range(config.cycles):
                with timed(seconds, "collect"):  # line 3, Data generation
                    successes.append(collect(config.random_actions))
                    env_steps += num_envs * horizon
                with timed(seconds, "train"):  # line 12, Training
                    with in_thread(algorithm_1) if config.her_thread else nullcontext():
                        for _ in range(config.updates):
                            if not config.her_thread:
                                algorithm_1()  # line 13, at a fixed rate
                            for k in range(heads):  # line 14
                                batch = her_buffer.sample(batch_size, draw_rng)  # line 15
                                losses.append(agent.update_head(k, batch))  # line 16
                                originals.append(1 - batch["hindsight"].mean())
                    agent.update_targets()
                bar.update()
            with timed(seconds, "eval"):
                envs.reset(test_seed)
                test = evaluate(envs, agent, heads, horizon, test_rounds, bar)
            bar.close()

            critic_loss, actor_loss = torch.stack(losses).mean(dim=0).tolist()
            if not math.isfinite(critic_loss + actor_loss):
                raise FloatingPointError(f"NaN or Inf in the losses of epoch {epoch}")
            rows.append(
                {
                    "epoch": epoch,
                    "env_steps": env_steps,
                    "wall_seconds": time.perf_counter() - start,
                    "train_success_rate": float(np.mean(successes)),
                    **test,
                    "critic_loss": critic_loss,
                    "actor_loss": actor_loss,
                    **variance_by_kind(agent, her_buffer),
                    "batch_original_fraction": float(np.mean(originals)),
                    "her_buffer_size": her_buffer.size,
                    **{f"{name}_seconds": value for name, value in seconds.items()},
                }
            )
            records.add_row(folder, rows[-1])
            tqdm.write(
                "epoch {epoch:3d}  steps {env_steps:7d}  test success {test_success_rate:.3f}  "
                "train success {train_success_rate:.3f}  Q {test_q:6.2f}  "
                "{wall_seconds:.0f} s".format(**rows[-1])
            )
    return rows


def parse(argv: list[str] | None) -> Config:
    """The command line: an option for each field of Config that has a text."""
    parser = argparse.ArgumentParser(description="Value Consistency Prioritization: VCP")
    parser.error = fail
    for f in fields(Config):
        if not f.metadata:
            continue
        flag, text = "--" + f.name.replace("_", "-"), f.metadata["help"]
        if f.type is bool:
            parser.add_argument(flag, action="store_true", help=text)
        else:
            kind = next(t for t in (int, float, str) if t in (f.type, *get_args(f.type)))
            text += "" if f.default is None else " (default: %(default)s)"
            choices = f.metadata["choices"]
            parser.add_argument(flag, type=kind, default=f.default, choices=choices, help=text)
    return Config(**vars(parser.parse_args(argv)))


def fail(message: str) -> NoReturn:
    print(f"run.py: {message}", file=sys.stderr)
    sys.exit(2)


def main(argv: list[str] | None = None) -> None:
    config = parse(argv)
    try:
        train(config)
    except UsageError as error:
        fail(str(error))


if __name__ == "__main__":
    main()
