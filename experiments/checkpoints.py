"""A run's last checkpoint, for the programs that look into it."""

from pathlib import Path
from types import SimpleNamespace

import options
import records
import run
from envs_point import UsageError, make_env
from her import EpisodeBuffer


def restored(folder: Path) -> SimpleNamespace:
    """The run in `folder` after its last whole epoch: config, epoch, env (closed), reward_fn,
    agent, original (B_o) and replay (B_h, or another method's). UsageError if there is none."""
    config, saved = options.load(folder), records.load_checkpoint(folder)
    if saved is None:
        raise UsageError(f"{folder} holds no run with a whole epoch")
    env = make_env(config.env)
    env.close()

    def reward_fn(achieved, desired):
        return env.unwrapped.compute_reward(achieved, desired, {})

    dims = [env.observation_space[name].shape[0] for name in ("observation", "desired_goal")]
    horizon, actions = env.spec.max_episode_steps, env.action_space.shape[0]
    agent = run.make_agent(config, env)
    original = EpisodeBuffer(config.buffer_size, horizon, *dims, actions)
    replay = run.make_replay(config, env, original, reward_fn)
    for part, state in zip((agent, original, replay), saved["parts"], strict=True):
        part.load_state_dict(state)
    return SimpleNamespace(
        config=config,
        epoch=len(saved["rows"]),
        env=env,
        reward_fn=reward_fn,
        agent=agent,
        original=original,
        replay=replay,
    )
