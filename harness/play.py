"""Look at what a run learned: python run.py --play DIR [--gif FILE]"""

import os
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image
from tqdm.auto import tqdm

from ensemble import EnsembleDDPG
from harness.assemble import load, restored
from harness.errors import UsageError
from harness.tasks import succeeded

EPISODES = 10  # of each head
SHOWN = 3  # of the best head
SEED = 1_000_000


def play(folder: Path, gif: str | None = None) -> np.ndarray:
    """Play EPISODES test episodes with each head of the run in `folder`, print the success rates,
    and show SHOWN episodes of the best head: in a window where there is a display, or as the
    animation `gif`. Returns the success rate of each head, (K,). UsageError if nothing was learned
    yet, or for pictures that cannot be drawn."""
    parts, rows = restored(folder)
    agent, env = load(folder)
    seeds = range(SEED, SEED + EPISODES)
    rates = np.zeros(agent.heads)
    for head in tqdm(range(agent.heads), desc="heads", leave=False, disable=None):
        rates[head] = np.mean([episode(env, agent, head, seed)[0] for seed in seeds])
    env.close()
    best = int(rates.argmax())
    print(
        f"{parts.config.env} after epoch {rows[-1]['epoch']}: success {rates.mean():.3f} over"
        f" {agent.heads * EPISODES} episodes, the best head ({best}) {rates[best]:.2f}"
    )
    window = gif is None and (sys.platform in ("darwin", "win32") or "DISPLAY" in os.environ)
    if not window and not gif:
        print(f"no display; for an animation: python run.py --play {folder} --gif FILE.gif")
        return rates
    try:
        _, env = load(folder, render_mode="human" if window else "rgb_array")
        shown = [episode(env, agent, best, seed, pictures=True)[1] for seed in seeds[:SHOWN]]
        env.close()
        if gif:
            octree = Image.Quantize.FASTOCTREE  # keeps the colour of something as small as a goal
            frames = [Image.fromarray(frame) for frames in shown for frame in frames]
            images = [frame.resize((240, 240)).quantize(64, octree) for frame in frames]
            images[0].save(gif, save_all=True, append_images=images[1:], duration=60, loop=0)
            print(f"{gif}: {SHOWN} episodes, {os.path.getsize(gif) // 1024} KB")
    except OSError as error:
        raise UsageError(f"cannot write {gif}: {error.strerror or error}") from error
    except Exception as error:  # MuJoCo's renderers raise many kinds without a display or a driver
        hint = "without a display, set MUJOCO_GL=egl (a GPU's driver) or osmesa (libosmesa6)"
        raise UsageError(f"cannot draw {parts.config.env} ({error}); {hint}") from error
    return rates


def episode(
    env: gym.Env, agent: EnsembleDDPG, head: int, seed: int, pictures: bool = False
) -> tuple[bool, list[np.ndarray]]:
    """An episode of one head, without noise: its success at the last step and, where the
    environment draws any, its pictures, (height, width, 3) uint8, two steps apart."""
    obs, _ = env.reset(seed=seed)
    frames = []
    for t in range(env.spec.max_episode_steps):
        if pictures and env.render_mode == "rgb_array" and t % 2 == 0:
            frames.append(env.render())
        rows = obs["observation"][None, None], obs["desired_goal"][None, None]
        action = agent.act(*rows, slice(head, head + 1))[0, 0]
        obs, reward, _, _, info = env.step(action)
    return succeeded(reward, info), frames
