"""Algorithm 2, the VCP algorithm, line by line.

    python run.py --env FetchReach-v1

`train` is the algorithm. Its lines 3-11, which play the episodes, are in rollout.py, its settings
and the command line's in options.py.
"""

import math
import sys
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from tqdm import tqdm

import options
import records
from ensemble import EnsembleDDPG
from envs_point import UsageError, describe, make_env
from her import EpisodeBuffer, HERReplay, relabel_future
from options import Config
from rollout import actor, evaluate, explorer, rollout
from vcp import HERBuffer, score, update_her_buffer
from workers import ParallelEnvs, fast_products, one_thread, without_denormals

tqdm.monitor_interval = 0  # its watching thread would outlive a run


def variance_by_kind(agent: EnsembleDDPG, her_buffer: HERBuffer, most: int = 4096) -> dict:
    """Figure 4: the mean variance of the critics NOW on the hindsight and the original transitions
    of B_h or, without VCP, of what was drawn last; from about `most` of them, evenly spread."""
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


def make_agent(config: Config, env: gym.Env) -> EnsembleDDPG:
    """Algorithm 2, line 1: the off-policy algorithm 𝔸, for an environment of `make_env`."""
    return EnsembleDDPG(
        obs_dim=env.observation_space["observation"].shape[0],
        goal_dim=env.observation_space["desired_goal"].shape[0],
        action_dim=env.action_space.shape[0],
        heads=config.heads,
        gamma=1 - 1 / env.spec.max_episode_steps,
        learning_rate=config.learning_rate,
        trunk_rate=config.trunk_rate,
        polyak=config.polyak,
        action_penalty=config.action_penalty,
        device=config.device,
        seed=config.seed,
    )


def make_replay(config: Config, env: gym.Env, original_buffer: EpisodeBuffer, reward_fn):
    """What Algorithm 2, line 15, draws from: B_h, or the replay of another `--method`."""
    drawn = config.updates * config.heads  # mini-batches in a cycle
    if config.method == "vcp":
        return HERBuffer(
            capacity=config.her_buffer_capacity,
            temperature=config.temperature,
            priority=config.priority,
            importance=config.importance,
        )
    her = (original_buffer, config.relabel_ratio, reward_fn)
    at_once = max(n for n in range(1, 41) if drawn % n == 0)
    if config.method == "her":
        return HERReplay(*her, at_once=at_once)
    from baselines import cher, dtgsh, herebp

    common = {"env_name": config.env, "faithful": config.faithful, "at_once": at_once}
    if config.method == "herebp":
        return herebp.HEREBP(*her, **common, dt=getattr(env.unwrapped, "dt", 1.0))
    if config.method == "cher":
        return cher.CHER(*her, **common, heads=config.heads, updates=config.cycles * config.updates)
    return dtgsh.DTGSH(*her, **common)


@one_thread()
@without_denormals()
def train(config: Config, resume: bool = False) -> list[dict]:
    """Algorithm 2. Writes the run's folder and gives the rows of its progress.csv.

    resume: go on with the run in config.out, after its last whole epoch. Everything random follows
    from (seed, epoch), so the rows are those of a run that was never stopped.
    UsageError, before anything is written, for a config that cannot be run; FloatingPointError
    where NaN or Inf turns up.
    """
    config = options.complete(config)
    folder = Path(config.out)
    env = make_env(config.env)
    env.close()
    horizon = env.spec.max_episode_steps  # T
    heads, batch_size = config.heads, config.batch_size
    # One environment a head; fewer than 16 heads have several each, for the paper's amount of data.
    num_envs = heads * math.ceil(16 / heads)
    test_rounds = math.ceil(config.eval_episodes / num_envs)

    # Line 1: the off-policy algorithm 𝔸, B_o and B_h
    agent = make_agent(config, env)
    dims = [env.observation_space[name].shape[0] for name in ("observation", "desired_goal")]
    original_buffer = EpisodeBuffer(config.buffer_size, horizon, *dims, env.action_space.shape[0])

    def reward_fn(achieved, desired):
        return env.unwrapped.compute_reward(achieved, desired, {})  # Eq. (1)

    her_buffer = make_replay(config, env, original_buffer, reward_fn)
    vcp = config.method == "vcp"

    def collect(random_actions):  # lines 3-11
        acting = heads if config.acting_head == "all" else 1
        policy = actor(agent, acting, num_envs)
        shape = (horizon, num_envs, env.action_space.shape[0])
        policy = explorer(policy, play_rng, shape, config.noise, random_actions)
        episodes, success = rollout(envs, policy, horizon)
        slots = original_buffer.add(episodes, play_rng)  # line 9
        if not vcp:
            her_buffer.new_episodes(slots)
        # The normaliser sees what the networks will: relabelled goals too.
        size = num_envs * horizon
        seen = relabel_future(episodes, size, play_rng, config.relabel_ratio, reward_fn)
        agent.normalizer.update(np.concatenate([seen["obs"], seen["goal"]], axis=1))
        return success

    scored = round(config.scored_per_drawn * heads * batch_size)  # by Algorithm 1, a sweep

    rows, env_steps, start = [], 0, time.perf_counter()
    parts = (agent, original_buffer, her_buffer)
    saved = records.load_checkpoint(folder) if resume else None
    if saved:
        for part, state in zip(parts, saved["parts"], strict=True):
            part.load_state_dict(state)
        rows = saved["rows"]
        env_steps, start = rows[-1]["env_steps"], start - rows[-1]["wall_seconds"]

    with (
        ParallelEnvs(config.env, num_envs, config.num_workers, heads) as envs,
        ThreadPoolExecutor(1) as thread,
        fast_products(),
    ):
        records.start(folder, asdict(config), rows, resume)
        print(describe(config.env))
        for epoch in range(len(rows) + 1, config.epochs + 1):  # line 2
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
                    relabelling = (her_rng, config.relabel_ratio, reward_fn)
                    if vcp and not her_buffer.size:  # something to draw, once, of all there is
                        first = min(original_buffer.size * horizon, her_buffer.capacity)
                        its = (original_buffer, her_buffer, agent.q_variance)
                        update_her_buffer(*its, first, *relabelling)
                    for _ in range(config.updates):
                        if vcp:  # line 13: Algorithm 1, its lines 3-5, in another thread
                            its = (original_buffer, agent.frozen_q_variance())
                            scoring = thread.submit(score, *its, scored, *relabelling)
                        for k in range(heads):  # line 14
                            batch = her_buffer.sample(batch_size, draw_rng)  # line 15
                            losses.append(agent.update_head(k, batch))  # line 16
                            originals.append(1 - batch["hindsight"].mean())
                        if vcp:  # both are done: Algorithm 1, lines 6-7
                            her_buffer.add(*scoring.result())
                            her_buffer.update_priorities()
                    agent.update_targets()
                bar.update()
            with timed(seconds, "eval"):
                envs.reset(test_seed)
                test = evaluate(envs, agent, heads, horizon, test_rounds, bar)
            bar.close()

            critic_loss, actor_loss = torch.stack(losses).mean(dim=0).tolist()
            if not math.isfinite(critic_loss + actor_loss):
                raise FloatingPointError(f"NaN or Inf in the losses of epoch {epoch}")
            row = {
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
            rows.append(row)
            records.save_checkpoint(
                folder, {"rows": rows, "parts": [p.state_dict() for p in parts]}
            )
            records.write_rows(folder, rows)
            if config.tensorboard:
                records.add_to_tensorboard(folder, row)
            tqdm.write(
                "epoch {epoch:3d}  steps {env_steps:7d}  test success {test_success_rate:.3f}  "
                "train success {train_success_rate:.3f}  Q {test_q:6.2f}  "
                "{wall_seconds:.0f} s".format(**row)
            )
    return rows


def main(argv: list[str] | None = None) -> None:
    """The command line. Exit code 2 and one line for bad input, 1 and one line for a run that
    something outside the program stopped, 130 for Ctrl-C."""
    given, command = options.parse(argv)
    try:
        if command.play:
            from play import play  # it imports this module

            play(Path(command.play), command.gif)
            return
        config = Config(**given)
        if command.resume:
            saved = options.load(Path(command.resume))
            config = options.changed(saved, {**given, "out": command.resume})
        config = options.complete(config)
        try:
            train(config, resume=bool(command.resume))
        except (FloatingPointError, OSError, KeyboardInterrupt) as error:
            epoch = records.epochs_done(Path(config.out)) + 1
            reason = f": {error}" if str(error) else ""
            print(f"run.py: stopped in epoch {epoch}{reason}", file=sys.stderr, end="; ")
            print(f"to go on: python run.py --resume {config.out}", file=sys.stderr)
            sys.exit(130 if isinstance(error, KeyboardInterrupt) else 1)
    except UsageError as error:
        options.fail(str(error))
    except KeyboardInterrupt:  # while it plays
        sys.exit(130)


if __name__ == "__main__":
    main()
