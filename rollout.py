"""Algorithm 2, lines 3-11: episodes, for training with HER's exploration and for testing without.

Letters in the shape comments:
    K heads    N environments, n of them    T steps of an episode    O observation    G goal
    A action
"""

import math

import numpy as np

from ensemble import EnsembleDDPG
from workers import ParallelEnvs, small_calls


def rollout(envs: ParallelEnvs, policy, horizon: int) -> tuple[dict, np.ndarray]:
    """Algorithm 2, lines 4-11: an episode in each environment, all at once.

    policy: step t, the rows of some of the N environments as a slice, their observations (n, O) and
    goals (n, G) -> their actions (n, A) in [-1, 1]. The workers ask at their own pace.
    Gives the episodes, with the arrays of her.EpisodeBuffer, and is_success at the last step, (N,).
    """

    def play(worker):
        steps, actions = [worker.reset()], []  # line 5
        goal = steps[0]["desired_goal"]
        for t in range(horizon):  # line 6
            obs = steps[-1]["observation"]
            actions.append(np.float32(policy(t, worker.rows, obs, goal)))  # line 7
            obs, success = worker.step(actions[-1])  # line 8
            steps.append(obs)
        episodes = {
            "obs": np.stack([obs["observation"] for obs in steps], axis=1),  # (n, T+1, O)
            "achieved_goal": np.stack([obs["achieved_goal"] for obs in steps], axis=1),
            "desired_goal": goal,  # (n, G)
            "action": np.stack(actions, axis=1),  # (n, T, A)
        }
        return episodes, success

    with small_calls():
        parts, successes = zip(*envs.each(play), strict=True)
    episodes = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    for name, array in episodes.items():
        if not np.isfinite(array).all():
            raise FloatingPointError(f"NaN or Inf in the {name} of an episode")
    return episodes, np.concatenate(successes)


def by_head(rows: np.ndarray, heads: int) -> np.ndarray:
    """(N, ..., D) -> (heads, -1, D): the first N/heads environments are head 0's, and so on."""
    return rows.reshape(heads, -1, rows.shape[-1])


def actor(agent: EnsembleDDPG, heads: int, num_envs: int):
    """A policy for `rollout`: the first `heads` heads without noise, which share the environments
    evenly."""

    def act(t, rows, obs, goal):
        k = slice(rows.start * heads // num_envs, math.ceil(rows.stop * heads / num_envs))
        action = agent.act(by_head(obs, k.stop - k.start), by_head(goal, k.stop - k.start), k)
        return action.reshape(len(obs), -1)

    return act


def explorer(policy, rng: np.random.Generator, shape, noise: float, random_actions: float):
    """`policy` with HER's exploration (not in the paper): Gaussian noise, then some actions uniform
    instead. shape: (T, N, A) of all that is drawn for an episode in each environment."""
    gaussian = noise * rng.standard_normal(shape)
    uniform = rng.uniform(-1, 1, shape)
    instead = rng.random((*shape[:2], 1)) < random_actions

    def explore(t, rows, obs, goal):
        noisy = np.clip(policy(t, rows, obs, goal) + gaussian[t, rows], -1, 1)
        return np.where(instead[t, rows], uniform[t, rows], noisy)

    return explore


def evaluate(envs, agent: EnsembleDDPG, heads: int, horizon: int, rounds: int, bar) -> dict:
    """Section 5.1: `rounds` episodes in each environment, by all heads, without noise. The success
    rate, and the mean of Q_k(s, μ_k(s, g), g) over all steps."""
    successes, q = [], []
    for _ in range(rounds):
        episodes, success = rollout(envs, actor(agent, heads, envs.num_envs), horizon)
        obs = episodes["obs"][:, :-1]  # (N, T, O)
        goal = np.repeat(episodes["desired_goal"][:, None], horizon, axis=1)  # (N, T, G)
        q.append(agent.value(by_head(obs, heads), by_head(goal, heads)))
        successes.append(success)
        bar.update()
    return {"test_success_rate": float(np.mean(successes)), "test_q": float(np.mean(q))}
