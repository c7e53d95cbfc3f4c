"""Algorithm 2, the VCP algorithm, in the order of its box.

    python run.py --env FetchReach-v1

`train` is the algorithm. Where a line of the box begins, its number stands at the end of the line
of code; `+` marks what is not in the box, and says where it is from. HER+ is HER's published code,
VCP+ the authors' (NOTES.md, "Hyper-parameters"). Algorithm 1 is in vcp.py. What is set up before
comes from harness/assemble.py, what is written down afterwards goes to harness/records.py.

Letters in the shape comments:
    K heads    N environments, n of them    T steps of an episode    O observation    G goal
    A action
"""

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from ensemble import EnsembleDDPG
from harness import cli, numerics, records
from harness.assemble import assemble
from harness.settings import Config, complete, scored_a_sweep
from harness.workers import ParallelEnvs, Worker
from her import relabel_future
from vcp import score, update_her_buffer

# Step t, some of the N environments as a slice, their observations (n, O) and goals (n, G) ->
# their actions (n, A) in [-1, 1]
Policy = Callable[[int, slice, np.ndarray, np.ndarray], np.ndarray]


@numerics.for_training()
def train(config: Config, resume: bool = False) -> list[dict]:
    """Algorithm 2. Writes the run's folder and returns the rows of its progress.csv.

    resume: go on with the run in config.out, after its last whole epoch. Everything random follows
    from (seed, epoch), so the rows are those of a run that was never stopped.
    UsageError, before anything is written, for a config that cannot be run; FloatingPointError
    where NaN or Inf turns up.
    """
    config = complete(config)
    folder = Path(config.out).absolute()  # an environment may change the working folder
    its = assemble(config)  # 1: the off-policy algorithm 𝔸, B_o and B_h
    agent, original_buffer, her_buffer = its.agent, its.original_buffer, its.her_buffer
    heads, num_envs, horizon = config.heads, its.num_envs, its.task.horizon
    acting = heads if config.acting_head == "all" else 1  # Section 5.6
    noise_shape, steps = (horizon, num_envs, its.task.action_dim), num_envs * horizon
    test_rounds, began = math.ceil(config.eval_episodes / num_envs), time.perf_counter()
    with (
        its.envs() as envs,
        records.held(folder, asdict(config), its.state(), resume) as rows,
        ThreadPoolExecutor(1) as thread,
    ):
        began -= rows[-1]["wall_seconds"] if rows else 0
        print(its.task.made)
        for epoch in range(len(rows) + 1, config.epochs + 1):  # 2: M epochs
            train_seed, test_seed, play_rng, her_rng, draw_rng = randomness(config.seed, epoch)
            relabelling = (her_rng, config.relabel_ratio, its.task.reward_fn)
            notes = records.Notes(epoch, config.epochs, config.cycles + test_rounds)
            envs.reset(train_seed)
            # + Appendix B: n cycles an epoch; VCP+: before the first one an episode at random in
            # each environment, cycle 0, after which nothing is trained
            for cycle in range(epoch > 1, config.cycles + 1):
                with notes.timed("collect"):  # 3: data generation
                    random_actions = config.random_actions if cycle else 1
                    policy = greedy(agent, acting, num_envs)  # each head has its environments
                    policy = exploring(policy, play_rng, noise_shape, config.noise, random_actions)
                    episodes, success = rollout(envs, policy, horizon)  # 4-8, 10, 11
                    slots = original_buffer.add(episodes, play_rng)  # 9: into B_o
                    # + HER+: the normaliser sees what the networks will, relabelled goals too
                    seen = relabel_future(episodes, steps, play_rng, *relabelling[1:])
                    agent.normalizer.update(np.concatenate([seen["obs"], seen["goal"]], axis=1))
                    if her_buffer is None:  # + another method's replay
                        its.replay.new_episodes(slots)
                if not cycle:
                    continue
                notes.successes.append(success)

                with notes.timed("train"):  # 12: training
                    if her_buffer and not her_buffer.size:
                        # + so that there is something to draw: once, as much as B_o holds
                        first = min(original_buffer.size * horizon, her_buffer.capacity)
                        scoring = (her_buffer, original_buffer, agent.q_variance, first)
                        update_her_buffer(*scoring, *relabelling)
                    for _ in range(config.updates):  # + VCP+: 5 or 40 sweeps of the heads a cycle
                        if her_buffer:  # 13: in another thread, Algorithm 1, its lines 3-5
                            scoring = (agent.frozen_q_variance(), scored_a_sweep(config))
                            scored = thread.submit(score, original_buffer, *scoring, *relabelling)
                        for k in range(heads):  # 14: for each head
                            batch = its.replay.sample(config.batch_size, draw_rng)  # 15: from B_h
                            # + NOTES.md: of heads_at_once heads the last one steps, for all
                            step = (k + 1) % config.heads_at_once == 0
                            notes.losses.append(agent.update_head(k, batch, step))  # 16: 𝔸
                            notes.originals.append(1 - batch["hindsight"].mean())
                        if her_buffer:  # 17: both are done; Algorithm 1, its lines 6-7
                            her_buffer.add(*scored.result())
                            her_buffer.update_priorities()
                    agent.update_targets()  # + HER+: once a cycle

            envs.reset(test_seed)  # + Section 5.1
            tests = []
            for _ in range(test_rounds):
                with notes.timed("eval"):
                    tests.append(evaluate(envs, agent, heads, horizon))
            test = tuple(float(np.mean(part)) for part in zip(*tests, strict=True))
            env_steps = steps * (epoch * config.cycles + 1)
            rows.append(notes.row(env_steps, test, agent, its.replay, began))
            records.save(folder, asdict(config), rows, its.state())
            notes.write(rows[-1])
    return rows  # 18


def randomness(seed: int, epoch: int) -> tuple:
    """Two seeds, of the environments in training and in tests, and three generators, for episodes,
    for Algorithm 1 and for what the heads draw."""
    seeds = np.random.SeedSequence([seed, epoch])
    return *map(int, seeds.generate_state(2)), *map(np.random.default_rng, seeds.spawn(3))


# ------------------------------------------------------------------------------ lines 4-11


def rollout(envs: ParallelEnvs, policy: Policy, horizon: int) -> tuple[dict, np.ndarray]:
    """Algorithm 2, lines 4-11: an episode in each environment, all at once.

    Returns the episodes, with the arrays of her.EpisodeBuffer, and is_success at the last step,
    (N,). The workers ask the policy at their own pace. FloatingPointError for NaN or Inf in the
    actions.
    """
    with numerics.small_calls():
        parts = envs.each(partial(episodes_of, policy=policy, horizon=horizon))
    parts, successes = zip(*parts, strict=True)
    episodes = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return episodes, np.concatenate(successes)


def episodes_of(worker: Worker, policy: Policy, horizon: int) -> tuple[dict, np.ndarray]:
    """`rollout` for the environments of one worker."""
    steps, actions = [worker.reset()], []  # 5: goals and initial states
    goal = steps[0]["desired_goal"]
    for t in range(horizon):  # 6: T steps
        actions.append(np.float32(policy(t, worker.rows, steps[-1]["observation"], goal)))  # 7: a_t
        if not np.isfinite(actions[-1]).all():
            raise FloatingPointError("NaN or Inf in the actions, so in the networks")
        obs, success = worker.step(actions[-1])  # 8: s_{t+1}; Eq. (1) gives r_t when it is needed
        steps.append(obs)
    episodes = {
        "obs": np.stack([obs["observation"] for obs in steps], axis=1),  # (n, T+1, O)
        "achieved_goal": np.stack([obs["achieved_goal"] for obs in steps], axis=1),
        "desired_goal": goal,  # (n, G)
        "action": np.stack(actions, axis=1),  # (n, T, A)
    }
    return episodes, success


def by_head(rows: np.ndarray, heads: int) -> np.ndarray:
    """(N, ..., D) -> (heads, -1, D): the first N/heads environments are head 0's, and so on."""
    return rows.reshape(heads, -1, rows.shape[-1])


def greedy(agent: EnsembleDDPG, heads: int, num_envs: int) -> Policy:
    """μ_k without noise, of the first `heads` heads, which share the environments evenly."""

    def act(t, rows, obs, goal):
        k = slice(rows.start * heads // num_envs, math.ceil(rows.stop * heads / num_envs))
        action = agent.act(by_head(obs, k.stop - k.start), by_head(goal, k.stop - k.start), k)
        return action.reshape(len(obs), -1)

    return act


def exploring(
    policy: Policy, rng: np.random.Generator, shape, noise: float, random_actions: float
) -> Policy:
    """π_k: `policy` with HER's exploration (not in the paper): Gaussian noise, then some actions
    uniform instead. shape: (T, N, A) of all that is drawn for an episode in each environment."""
    gaussian = noise * rng.standard_normal(shape)
    uniform = rng.uniform(-1, 1, shape)
    instead = rng.random((*shape[:2], 1)) < random_actions

    def act(t, rows, obs, goal):
        noisy = np.clip(policy(t, rows, obs, goal) + gaussian[t, rows], -1, 1)
        return np.where(instead[t, rows], uniform[t, rows], noisy)

    return act


def evaluate(
    envs: ParallelEnvs, agent: EnsembleDDPG, heads: int, horizon: int
) -> tuple[np.ndarray, np.ndarray]:
    """Section 5.1: an episode in each environment, by all heads, without noise. Returns
    is_success (N,), and Q_k(s, μ_k(s, g), g) of all steps, (K, ...)."""
    episodes, success = rollout(envs, greedy(agent, heads, envs.num_envs), horizon)
    obs = episodes["obs"][:, :-1]  # (N, T, O)
    goal = np.repeat(episodes["desired_goal"][:, None], horizon, axis=1)  # (N, T, G)
    return success, agent.value(by_head(obs, heads), by_head(goal, heads))


if __name__ == "__main__":
    cli.main(train)
