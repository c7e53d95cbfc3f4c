"""VCP in Stable-Baselines3: python with_stable_baselines3.py consistency|uniform|her SEED STEPS"""

import sys
from types import SimpleNamespace

import numpy as np
import torch
from stable_baselines3 import TD3, HerReplayBuffer
from stable_baselines3.common import callbacks, env_util, noise, type_aliases, utils, vec_env

from vcp import HERBuffer, update_her_buffer


class VCPReplayBuffer(HerReplayBuffer):  # it is B_o; mini-batches come from B_h
    def __init__(self, *args, priority, seed, temperature=9.0, capacity=5_120, **kwargs):
        super().__init__(*args, **kwargs)
        # TD3 has no loss weights: it draws by p_i² where it should draw by p_i and weight by p_i.
        self.her_buffer = HERBuffer(capacity, 2 * temperature, priority)
        self.original_buffer = SimpleNamespace(sample=self.relabelled)
        self.rng = np.random.default_rng(seed)

    def relabelled(self, batch_size, rng):  # Algorithm 1, lines 3-4; SB3 has an rng of its own
        batch = super().sample(batch_size)
        rows = {"action": batch.actions, "reward": batch.rewards}
        rows["goal"] = batch.observations["desired_goal"]
        for name, obs in (("obs", batch.observations), ("next_obs", batch.next_observations)):
            rows[name] = torch.cat([obs["observation"], obs["achieved_goal"]], 1)
        return {name: x.numpy() for name, x in rows.items()}

    def sample(self, batch_size, env=None):
        def inputs(obs, goal):
            obs, achieved = np.split(obs, [-goal.shape[1]], axis=1)
            state = {"observation": obs, "achieved_goal": achieved, "desired_goal": goal}
            return {key: self.to_torch(x) for key, x in self._normalize_obs(state, env).items()}

        @torch.no_grad()
        def q_variance(obs, action, goal):
            q = self.critic(inputs(obs, goal), self.to_torch(action))
            return torch.cat(q, 1).var(1, correction=0).numpy()

        update_her_buffer(self.her_buffer, self.original_buffer, q_variance, batch_size, self.rng)
        rows = self.her_buffer.sample(batch_size, self.rng)
        obs, next_obs = (inputs(rows[name], rows["goal"]) for name in ("obs", "next_obs"))
        action, reward = (self.to_torch(rows[name]) for name in ("action", "reward"))
        return type_aliases.DictReplayBufferSamples(obs, action, next_obs, 0 * reward, reward)


class EnsembleDDPG(TD3):  # one actor, and critics each with a target of its own
    def train(self, gradient_steps, batch_size):
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, self._vec_normalize_env)
            obs, next_obs = batch.observations, batch.next_observations
            with torch.no_grad():
                next_q = torch.cat(self.critic_target(next_obs, self.actor_target(next_obs)), 1)
                target = (batch.rewards + self.gamma * next_q).clamp(-1 / (1 - self.gamma), 0)
            q = torch.cat(self.critic(obs, batch.actions), 1)
            self.step(self.critic, self.critic_target, (q - target).square().mean(0).sum())
            action = self.actor(obs)
            q = torch.cat(self.critic(obs, action), 1)
            self.step(self.actor, self.actor_target, action.square().mean() - q.mean())

    def step(self, net, target, loss):
        net.optimizer.zero_grad()
        loss.backward()
        net.optimizer.step()
        utils.polyak_update(net.parameters(), target.parameters(), self.tau)


if __name__ == "__main__":
    priority, seed, steps = sys.argv[1], *map(int, sys.argv[2:])
    fetch = "gymnasium_robotics:FetchReach-v4"
    train_envs, test_envs = (env_util.make_vec_env(fetch, 8, seed + k) for k in (0, 100))
    tests = vec_env.VecNormalize(test_envs, training=False, norm_reward=False)
    her = priority == "her"
    model = EnsembleDDPG(
        "MultiInputPolicy",
        vec_env.VecNormalize(train_envs, norm_reward=False),
        learning_starts=400,  # an episode in each environment
        gradient_steps=4,
        batch_size=64,
        tau=0.02,
        gamma=0.98,
        action_noise=noise.NormalActionNoise(np.zeros(4), 0.2 * np.ones(4)),
        policy_kwargs={"net_arch": [64, 64], "n_critics": 16},
        replay_buffer_class=HerReplayBuffer if her else VCPReplayBuffer,
        replay_buffer_kwargs={} if her else {"priority": priority, "seed": seed},
        seed=seed,
        device="cpu",
    )
    model.replay_buffer.critic = model.critic  # SB3 makes it after the buffer
    model.learn(steps, callbacks.EvalCallback(tests, n_eval_episodes=30, eval_freq=25))
