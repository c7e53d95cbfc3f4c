"""Look at what a run learned: python run.py --play DIR [--gif FILE]"""

import os
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image
from tqdm import tqdm

import options
import records
from envs_point import UsageError, make_env
from rollout import actor, rollout
from run import make_agent
from workers import ParallelEnvs

EPISODES = 10  # of each head
SHOWN = 3  # of the best head
SEED = 1_000_000


def play(folder: Path, gif: str | None = None) -> np.ndarray:
    """Play EPISODES test episodes with each head of the run in `folder`, print the success rates,
    and show SHOWN episodes of the best head: in a window where there is a display, or as the
    animation `gif`. Gives the success rate of each head, (K,). UsageError if nothing was learned
    yet, or for pictures that cannot be drawn."""
    # A run from a GPU can be played without one.
    config = replace(options.load(folder), device="auto", tensorboard=False)
    config = options.complete(config)
    saved = records.load_checkpoint(folder)
    if saved is None:
        raise UsageError(f"the run in {folder} has no whole epoch yet")
    window = gif is None and (sys.platform in ("darwin", "win32") or "DISPLAY" in os.environ)
    mode = "human" if window else "rgb_array" if gif else None
    env = make_env(config.env, render_mode=mode)
    agent = make_agent(config, env)
    agent.load_state_dict(saved["parts"][0])

    heads, horizon = config.heads, env.spec.max_episode_steps
    successes = []
    with ParallelEnvs(config.env, heads, config.num_workers, heads) as envs:
        envs.reset(SEED)
        for _ in tqdm(range(EPISODES), leave=False, disable=None):
            successes.append(rollout(envs, actor(agent, heads, heads), horizon)[1])
    rates = np.mean(successes, axis=0)  # (K,)
    best = int(rates.argmax())
    print(
        f"{config.env} after epoch {saved['rows'][-1]['epoch']}: success {rates.mean():.3f} over"
        f" {heads * EPISODES} episodes, the best head ({best}) {rates[best]:.2f}"
    )
    try:
        if window:
            show(env, agent, best)
        elif gif:
            frames = show(env, agent, best)
            octree = Image.Quantize.FASTOCTREE  # keeps the colour of something as small as a goal
            images = [Image.fromarray(f).resize((240, 240)).quantize(64, octree) for f in frames]
            images[0].save(gif, save_all=True, append_images=images[1:], duration=60, loop=0)
            print(f"{gif}: {SHOWN} episodes, {os.path.getsize(gif) // 1024} KB")
    except (AttributeError, ImportError, gym.error.DependencyNotInstalled) as error:
        # what MuJoCo's renderers raise without a display or a driver
        hint = "without a display, set MUJOCO_GL=egl (a GPU's driver) or osmesa (libosmesa6)"
        raise UsageError(f"cannot draw {config.env} ({error}); {hint}") from error
    except OSError as error:
        raise UsageError(f"cannot write {gif}: {error.strerror or error}") from error
    finally:
        env.close()
    return rates


def show(env: gym.Env, agent, head: int) -> list[np.ndarray]:
    """SHOWN episodes of one head; the pictures, (height, width, 3) uint8, two steps apart."""
    frames = []
    for episode in range(SHOWN):
        obs, _ = env.reset(seed=SEED + episode)
        for t in range(env.spec.max_episode_steps):
            if env.render_mode == "rgb_array" and t % 2 == 0:
                frames.append(env.render())
            rows = obs["observation"][None, None], obs["desired_goal"][None, None]
            obs, *_ = env.step(agent.act(*rows, slice(head, head + 1))[0, 0])
    return frames
