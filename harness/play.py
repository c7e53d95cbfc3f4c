"""Look at what was learned: python run.py --play DIR [--gif FILE] [--policy FILE]

A policy is one head's actor and the normaliser, an .npz of half a megabyte: NumPy arrays, which
cannot run code. `--play FILE.npz` plays it.
"""

import json
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from tqdm import tqdm

from ensemble import EnsembleDDPG
from harness import numerics
from harness.assemble import restored
from harness.border import Border
from harness.errors import EnvironmentFailed, UsageError
from harness.records import to_type, write_whole
from harness.tasks import make_env

EPISODES = 10  # of each head
SHOWN = 5  # of the best head
HELD = 10  # steps that a shown episode goes on for at its goal
SEED = 1_000_000
PIXELS = 360  # of an animation, each side
ABOUT = ("env", "episode_length", "method", "seed")  # what a policy says of its run


@numerics.for_training()
@numerics.small_calls()
def play(source: Path, gif: str | None = None, policy: str | None = None) -> np.ndarray:
    """Play EPISODES test episodes with each head of a run's folder or with a policy's file, print
    the success rates, write the best head to the file `policy`, and show SHOWN episodes of it: in a
    window, if there is a display and the environment has a window, or as the animation `gif`.
    Returns the success rate of each head, (K,). UsageError if nothing was learned yet, for a file
    that is no policy, and for pictures that cannot be drawn."""
    source = source.absolute()  # an environment may change the working folder
    gif, policy = (file and str(Path(file).absolute()) for file in (gif, policy))
    agent, about = read_policy(source) if source.is_file() else of_run(source)
    if gif:
        try_to_draw(about)
    env = make_env(about["env"], about["episode_length"])
    seeds = range(SEED, SEED + EPISODES)
    rates = np.zeros(agent.num_heads)
    for head in tqdm(range(agent.num_heads), desc="heads", leave=False, disable=None):
        rates[head] = np.mean([episode(env, agent, head, seed)[0] for seed in seeds])
    env.close()
    best = int(rates.argmax())
    print(
        f"{about['env']} after epoch {about['epoch']}: success {rates.mean():.3f} over"
        f" {agent.num_heads * EPISODES} episodes"
    )
    if agent.num_heads > 1:
        print(f"by head: {' '.join(f'{rate:.1f}' for rate in rates)}; the best is {best}")
    if policy:
        write_policy(Path(policy), agent, best, about)
        print(f"{policy}: head {best}, {os.path.getsize(policy) // 1024} KB")
    display = sys.platform in ("darwin", "win32") or "DISPLAY" in os.environ
    window = gif is None and display and "human" in env.metadata.get("render_modes", ())
    if gif or window:
        show(about, agent, best, seeds[:SHOWN], gif)
    elif not policy:
        print(f"no window; for an animation: {to_type('--play', source)} --gif FILE.gif")
    return rates


def try_to_draw(about: dict) -> None:
    """Draw one picture, before all the episodes are played for it. Without a display MuJoCo asks a
    GPU's driver (EGL), unless MUJOCO_GL says otherwise. UsageError if it cannot be drawn."""
    if sys.platform == "linux" and "DISPLAY" not in os.environ:
        os.environ.setdefault("MUJOCO_GL", "egl")
    with drawing(about, "rgb_array") as env:
        env.reset(seed=SEED)
        env.render()


@contextmanager
def drawing(about: dict, mode: str) -> Iterator[Border]:
    """The environment, to be drawn in the block. UsageError where that fails: MuJoCo's renderers
    raise many kinds of errors without a display or a driver."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # gymnasium's, of a mode that is not there
            env = make_env(about["env"], about["episode_length"], render_mode=mode)
        with closing(env):
            yield env
    except (EnvironmentFailed, UsageError) as error:
        hint = "without a display, set MUJOCO_GL=egl (a GPU's driver) or osmesa (libosmesa6)"
        raise UsageError(f"cannot draw {about['env']} ({error}); {hint}") from error


def show(about: dict, agent: EnsembleDDPG, head: int, seeds: range, gif: str | None) -> None:
    """Episodes of a head as the animation `gif` or, without a name, in a window. UsageError where
    neither can be."""
    mode = "rgb_array" if gif else "human"
    with drawing(about, mode) as env:
        shown = [episode(env, agent, head, seed, mode)[1] for seed in seeds]
    if gif:
        octree = Image.Quantize.FASTOCTREE  # keeps the colour of something as small as a goal
        frames = [Image.fromarray(frame) for frames in shown for frame in frames]
        images = [frame.resize((PIXELS, PIXELS)).quantize(64, octree) for frame in frames]
        try:
            images[0].save(gif, save_all=True, append_images=images[1:], duration=60, loop=0)
        except OSError as error:
            raise UsageError(f"cannot write {gif}: {error.strerror or error}") from error
        print(f"{gif}: {len(seeds)} episodes, {os.path.getsize(gif) // 1024} KB")


def episode(
    env: Border, agent: EnsembleDDPG, head: int, seed: int, mode: str | None = None
) -> tuple[bool, list[np.ndarray]]:
    """An episode of one head, without noise: its success at the last step and, with the mode
    "rgb_array", a picture of each step, (height, width, 3) uint8. One that is looked at, with this
    mode or "human", ends when it has been at its goal for HELD steps."""
    obs, _ = env.reset(seed=seed)
    frames, held = [], 0
    for _ in range(env.horizon):
        if mode == "rgb_array":
            frames.append(env.render())
        rows = obs["observation"][None, None], obs["desired_goal"][None, None]
        action = agent.act(*rows, slice(head, head + 1))[0, 0]
        obs, *_, info = env.step(action)
        held = held + 1 if info["is_success"] else 0
        if mode and held == HELD:
            break
    return held > 0, frames


# ------------------------------------------------------------------------------ policies


def of_run(folder: Path) -> tuple[EnsembleDDPG, dict]:
    """The agent of the run in `folder`, and what a policy says of it. UsageError without one."""
    parts, rows = restored(folder)
    about = {name: getattr(parts.config, name) for name in ABOUT}
    return parts.agent, {**about, "epoch": rows[-1]["epoch"]}


def write_policy(path: Path, agent: EnsembleDDPG, head: int, about: dict) -> None:
    """What head `head` needs to act: its actor's eight tensors, the normaliser's mean and standard
    deviation (float32), and `about` as JSON. UsageError if it cannot be written."""
    tensors = [*agent.actor.trunk, *agent.actor.own[head]]
    arrays = {f"p{i}": p.detach().cpu().numpy() for i, p in enumerate(tensors)}
    scale = {name: getattr(agent.normalizer, name).cpu().numpy() for name in ("mean", "std")}
    text = np.array(json.dumps(about))
    try:
        write_whole(path, lambda file: np.savez_compressed(file, about=text, **arrays, **scale))
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror or error}") from error


@torch.no_grad()
def read_policy(path: Path) -> tuple[EnsembleDDPG, dict]:
    """An agent of one head that acts as the policy in `path` does, with critics that have learned
    nothing, and what the file says of its run. UsageError if the file is no whole policy."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        about = json.loads(str(arrays.pop("about")))
        env = make_env(about["env"], about["episode_length"])
        sizes = env.obs_dim, env.goal_dim, env.action_dim
        agent = EnsembleDDPG(*sizes, gamma=0.98, num_heads=1)
        env.close()
        tensors = {f"p{i}": p for i, p in enumerate(agent.actor.parameters())}
        tensors |= {name: getattr(agent.normalizer, name) for name in ("mean", "std")}
        for name, p in tensors.items():
            p.copy_(torch.from_numpy(arrays[name]).reshape(p.shape))
    except UsageError:
        raise
    except Exception as error:  # whatever a damaged file leads to
        raise UsageError(f"{path} holds no policy ({type(error).__name__}: {error})") from error
    return agent, about
