"""Algorithm 2, the VCP algorithm, in the order of its box.

    python run.py --env FetchReach-v1

`train` is the algorithm. Where a line of the box begins, a comment at the end of the code or above
it has the number of that line; `+` marks what is not in the box, and the comment says where it is
from. HER+ is HER's published code, VCP+ the authors' (NOTES.md, "Hyper-parameters"). Algorithm 1 is
in vcp.py. What is set up before comes from harness/assemble.py; what is noted goes to
harness/epoch.py, what is kept to harness/records.py.

Letters in the shape comments:
    K heads    N environments, n of them    T steps of an episode    O observation    G goal
    A action
"""

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ensemble import EnsembleDDPG
from harness import cli, numerics, records
from harness.assemble import assemble
from harness.epoch import Epoch
from harness.settings import Config, complete, scored_a_sweep
from harness.workers import ParallelEnvs
from her import relabel_future
from vcp import score, update_her_buffer

# Step t, some of the N environments as a slice, their observations (n, O) and goals (n, G) ->
# their actions (n, A) in [-1, 1]
Policy = Callable[[int, slice, np.ndarray, np.ndarray], np.ndarray]


@numerics.for_training()
def train(config: Config, resume: bool = False) -> list[dict]:
    """Algorithm 2. Writes the run's folder and returns the rows of its progress.csv.

    Where processes are spawned (macOS, Windows), a script calls it below `if __name__ ==
    "__main__":`, as each worker imports the script.
    resume: go on with the run in config.out, after its last whole epoch. Everything random follows
    from (seed, epoch), so the rows are those of a run that was never stopped.
    UsageError, before anything is written, for a config that cannot be run; FloatingPointError
    where NaN or Inf turns up; EnvironmentFailed for what an environment does wrong later, and
    ChildProcessError for a worker process that dies.
    """
    config = complete(config)
    folder = Path(config.out).absolute()  # an environment may change the working folder
    parts = assemble(config)  # 1: the off-policy algorithm 𝔸, B_o and B_h
    task, agent, replay = parts.task, parts.agent, parts.replay
    original_buffer, her_buffer = parts.original_buffer, parts.her_buffer
    vcp = config.method == "vcp"  # then replay is B_h; others have no B_h and a replay of their own
    num_envs, horizon = parts.num_envs, task.horizon
    acting = config.heads if config.acting_head == "all" else 1  # Section 5.6
    noise_shape = (horizon, num_envs, task.action_dim)
    # + ours: with many updates the heads step together (NOTES.md, "Heads in turn or at once")
    turns = np.arange(config.heads).reshape(-1, config.heads_at_once).tolist()
    test_rounds = math.ceil(config.eval_episodes / num_envs)
    began = time.perf_counter()
    with (
        parts.envs() as envs,
        records.held(folder, resume),
        ThreadPoolExecutor(1, initializer=numerics.begin_thread) as thread,  # for Algorithm 1
        # for the products of Algorithm 1 and of the heads
        ThreadPoolExecutor(parts.threads(), initializer=numerics.begin_thread) as pool,
    ):
        # heads in turn stay in this thread: in the pool they would wait behind what is scored
        map_heads = pool.map if config.heads_at_once > 1 else map
        rows = records.begin(folder, asdict(config), parts, resume)
        began -= rows[-1]["wall_seconds"] if rows else 0
        print(task.made)
        for number in range(len(rows) + 1, config.epochs + 1):  # 2: M epochs
            train_seed, test_seed, play_rng, her_rng, draw_rng = randomness(config.seed, number)
            epoch = Epoch(number, config.epochs, config.cycles + test_rounds)
            envs.reset(train_seed)
            # + Appendix B: n cycles an epoch; VCP+: before the first one cycle 0, an episode at
            # random in each environment, without training
            for cycle in range(0 if number == 1 else 1, config.cycles + 1):
                with epoch.timed("collect"):  # 3: data generation
                    at_random = config.random_actions if cycle else 1
                    drawn = exploration(play_rng, noise_shape, config.noise, at_random)
                    policy = acting_heads(agent, acting, num_envs, drawn)
                    episodes, success = rollout(envs, policy, horizon)  # 4-8, 10, 11
                    slots = original_buffer.add(episodes, play_rng)  # 9: into B_o
                    # + HER+: the normaliser sees what the networks will, relabelled goals too
                    steps, ratio = num_envs * horizon, config.relabel_ratio
                    seen = relabel_future(episodes, steps, play_rng, ratio, task.compute_reward)
                    agent.normalizer.update(np.concatenate([seen["obs"], seen["goal"]], axis=1))
                    if not vcp:  # + another method's replay
                        replay.new_episodes(slots)
                if cycle == 0:
                    continue
                epoch.successes.append(success)

                with epoch.timed("train"):  # 12: training
                    if vcp and her_buffer.size == 0:
                        # + so that there is something to draw: once, as much as B_o holds
                        first = min(original_buffer.size * horizon, her_buffer.capacity)
                        critics = agent.snapshot_q_variance(pool.map)
                        update_her_buffer(her_buffer, original_buffer, critics, first, her_rng)
                    for _ in range(config.updates):  # + VCP+: 5 or 40 sweeps of the heads a cycle
                        if vcp:  # 13: in another thread, Algorithm 1, its lines 3-5
                            critics = agent.snapshot_q_variance(pool.map)
                            count = scored_a_sweep(config)
                            scored = thread.submit(score, original_buffer, critics, count, her_rng)
                        for heads in turns:  # 14: for each head
                            # 15: a mini-batch of its own, from B_h
                            batches = [replay.sample(config.batch_size, draw_rng) for _ in heads]
                            losses = agent.update_heads(heads, batches, map_heads)  # 16: 𝔸
                            epoch.note(losses, batches)
                        if vcp:  # 17: both are done; Algorithm 1, its lines 6-7
                            her_buffer.add(*scored.result())
                            her_buffer.update_priorities()
                    agent.update_targets()  # + HER+: once a cycle; VCP+: for each head

            envs.reset(test_seed)  # + Section 5.1
            for _ in range(test_rounds):
                with epoch.timed("eval"):
                    epoch.tests.append(evaluate(envs, agent, horizon))
            env_steps = num_envs * horizon * (number * config.cycles + 1)
            rows.append(epoch.row(env_steps, agent, replay, time.perf_counter() - began))
            records.save(folder, asdict(config), rows, parts.state())
            epoch.write(rows[-1])
    return rows  # 18


def randomness(seed: int, epoch: int) -> tuple:
    """Two seeds, of the environments in training and in tests, and three generators, for episodes,
    for Algorithm 1 and for what the heads draw."""
    seeds = np.random.SeedSequence([seed, epoch])
    return *map(int, seeds.generate_state(2)), *map(np.random.default_rng, seeds.spawn(3))


# ------------------------------------------------------------------------------ lines 4-11


@numerics.small_calls()
def rollout(envs: ParallelEnvs, policy: Policy, horizon: int) -> tuple[dict, np.ndarray]:
    """Algorithm 2, lines 4-11: an episode in each environment, all at once.

    Returns the episodes, with the arrays of her.EpisodeBuffer, and is_success at the last step,
    (N,). FloatingPointError for NaN or Inf in the actions.
    """
    episodes, success = envs.empty_episodes(horizon), np.empty(envs.num_envs, bool)
    for half in envs.halves:
        half.reset()  # 5: goals and initial states
    for t in range(horizon + 1):  # 6: T steps, and what the last one leads to
        for half in envs.halves:  # while one acts, the other's environments step
            which = half.which
            observed, success[which] = half.wait()
            episodes["obs"][which, t] = observed["observation"]  # s_t
            episodes["achieved_goal"][which, t] = observed["achieved_goal"]
            episodes["desired_goal"][which] = observed["desired_goal"]
            if t < horizon:
                obs, goal = episodes["obs"][which, t], episodes["desired_goal"][which]
                action = policy(t, which, obs, goal)  # 7: a_t
                if not np.isfinite(action).all():
                    raise FloatingPointError("NaN or Inf in the actions, so in the networks")
                episodes["action"][which, t] = action
                # 8: on the way to s_{t+1}; Eq. (1) gives r_t when it is needed
                half.step(episodes["action"][which, t])
    return episodes, success


def acting_heads(agent: EnsembleDDPG, acting: int, num_envs: int, drawn=None) -> Policy:
    """π_k(s_t, g) of the first `acting` heads, which share the environments evenly: μ_k and what
    `exploration` has drawn, or μ_k alone. Each call is for all environments of some heads or, where
    one head acts, for any."""

    def policy(t: int, which: slice, obs: np.ndarray, goal: np.ndarray) -> np.ndarray:
        first, end = which.start * acting // num_envs, math.ceil(which.stop * acting / num_envs)
        rows = by_head(obs, end - first), by_head(goal, end - first)
        action = agent.act(*rows, slice(first, end)).reshape(len(obs), -1)
        if drawn is None:
            return action
        gaussian, uniform, instead = (x[t, which] for x in drawn)
        return np.where(instead, uniform, np.clip(action + gaussian, -1, 1))

    return policy


def exploration(rng: np.random.Generator, shape: tuple, noise: float, at_random: float) -> tuple:
    """HER's exploration, which is not in the paper: Gaussian noise of standard deviation `noise`,
    and some actions uniform instead, a share of `at_random`. It is drawn before the episodes, of
    shape (T, N, A), so that the number of workers does not change which environment gets what.
    Returns the noise, the uniform actions and where these are taken."""
    gaussian, uniform = noise * rng.standard_normal(shape), rng.uniform(-1, 1, shape)
    return gaussian, uniform, rng.random((*shape[:2], 1)) < at_random


def by_head(x: np.ndarray, heads: int) -> np.ndarray:
    """(N, ..., D) -> (heads, -1, D): the first N/heads rows are the first head's, and so on."""
    return x.reshape(heads, -1, x.shape[-1])


def evaluate(
    envs: ParallelEnvs, agent: EnsembleDDPG, horizon: int
) -> tuple[np.ndarray, np.ndarray]:
    """Section 5.1: an episode in each environment, by all heads, without noise. Returns
    is_success (N,), and Q_k(s, μ_k(s, g), g) of all steps, (K, ...)."""
    heads = agent.num_heads
    episodes, success = rollout(envs, acting_heads(agent, heads, envs.num_envs), horizon)
    obs = episodes["obs"][:, :-1]  # (N, T, O)
    goal = np.repeat(episodes["desired_goal"][:, None], horizon, axis=1)  # (N, T, G)
    return success, agent.value(by_head(obs, heads), by_head(goal, heads))


if __name__ == "__main__":
    cli.main(train)
