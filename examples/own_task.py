"""VCP on a task of your own: put it in Room's place. It needs vcp.py, her.py, ensemble.py."""

import numpy as np

from ensemble import EnsembleDDPG
from her import EpisodeBuffer
from vcp import HERBuffer, update_her_buffer

SIZES = 2, 2, 2  # of an observation, O, a goal, G, and an action, A
HORIZON, GAMMA = 40, 1 - 1 / 40  # steps of every episode, T, and 1 - 1/T
# If a task is not learned, change these, the first ones first.
PENALTY = 0.1  # on large actions; HER's code has 1, with which success falls back to .2 here
CYCLES, UPDATES, BATCH = 20, 5, 64  # a wall takes 60 cycles; the paper's tasks 2,500, 40, 256
TEMPERATURE = 9.0  # 𝒯 of Eq. (4); 1, 5, 9, 11 or 15 in the paper
HEADS = 16  # K; head k acts in environment k


def reward_fn(achieved, desired):
    """Eq. (1): 0 where the goal is reached, else -1. (..., G) and (..., G) -> (...)."""
    return -1.0 * (np.linalg.norm(achieved - desired, axis=-1) > 0.1)


class Room:  # K points, each with its goal; gymnasium.make_vec(ID, HEADS) can take its place
    def reset(self, seed=None):
        self.rng = self.rng if seed is None else np.random.default_rng(seed)
        self.xy, self.goal = self.rng.uniform(-1, 1, (2, HEADS, 2))
        return self.observe(), {}

    def step(self, action):  # (K, A) in [-1, 1]
        self.xy = np.clip(self.xy + 0.1 * action, -1, 1)
        return self.observe(), reward_fn(self.xy, self.goal), False, False, {}

    def observe(self):
        return {"observation": self.xy, "achieved_goal": self.xy, "desired_goal": self.goal}


def rollout(envs, agent, rng=None):
    """Algorithm 2, lines 4-11: K episodes, and which of them end at their goals, (K,)."""
    steps, actions = [envs.reset()[0]], []
    for _ in range(HORIZON):
        obs, goal = steps[-1]["observation"], steps[-1]["desired_goal"]
        action = agent.act(obs[:, None], goal[:, None])[:, 0]  # (K, 1, O), (K, 1, G) -> (K, 1, A)
        if rng is not None:  # HER's exploration
            noisy = np.clip(action + 0.2 * rng.standard_normal(action.shape), -1, 1)
            action = np.where(rng.random((HEADS, 1)) < 0.3, rng.uniform(-1, 1, action.shape), noisy)
        step, reward, *_ = envs.step(action)
        steps.append(step)
        actions.append(action)
    episodes = {
        "obs": np.stack([step["observation"] for step in steps], axis=1),  # (K, T+1, O)
        "achieved_goal": np.stack([step["achieved_goal"] for step in steps], axis=1),
        "desired_goal": goal,  # (K, G)
        "action": np.stack(actions, axis=1),  # (K, T, A)
    }
    return episodes, reward == 0


def train(envs, seed=0):
    envs.reset(seed=seed)
    rng = np.random.default_rng(seed)
    agent = EnsembleDDPG(*SIZES, gamma=GAMMA, num_heads=HEADS, action_penalty=PENALTY, seed=seed)
    original_buffer = EpisodeBuffer(1_000_000, HORIZON, *SIZES, 0.8, reward_fn)
    her_buffer = HERBuffer(UPDATES * HEADS * BATCH, TEMPERATURE)  # holds what a cycle draws
    for cycle in range(1, CYCLES + 1):
        original_buffer.add(rollout(envs, agent, rng)[0], rng)
        seen = original_buffer.sample(HEADS * HORIZON, rng)  # what the networks will see
        agent.normalizer.update(np.concatenate([seen["obs"], seen["goal"]], axis=1))
        for _ in range(UPDATES):  # Algorithm 1, then an update of each head
            update_her_buffer(her_buffer, original_buffer, agent.q_variance, HEADS * BATCH, rng)
            for k in range(HEADS):
                agent.update_head(k, her_buffer.sample(BATCH, rng))  # drawn by Eq. (4)
        agent.update_targets()
        if cycle % 5 == 0:
            success = np.mean([rollout(envs, agent)[1] for _ in range(10)])
            print(f"cycle {cycle}: success {success:.2f}")
    return success


if __name__ == "__main__":
    train(Room())
