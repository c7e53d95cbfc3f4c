"""The data behind Figures 3, 5 and 8, from runs on PointMassEmpty: python -m experiments.didactic

Trains the runs below runs/didactic, or goes on with them, and writes what the figures need of their
networks and buffers to results/didactic/NAME.npz. Figure 4's run is among them: half16.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import options
import records
import run
from envs_point import UsageError
from experiments.checkpoints import restored
from experiments.effective import effective_share
from experiments.figures import RESULTS
from experiments.variance_figures import STAGES
from options import Config
from workers import ParallelEnvs

SCHEDULE = {"env": "PointMassEmptyEnv-v1", "updates": 5, "batch_size": 64}
EPOCH = 10  # of Figures 3 and 8
SHOWN = 1000  # points of each kind that are kept for Figure 5
SIZES = (2, 4, 8, 16, 32)  # K of Figure 8
TRAJECTORIES = 5


def trained(config: Config, epoch: int):
    """The agent, B_o and B_h after `epoch` epochs of the run, which is trained as far as needed.
    UsageError for a run that is past that epoch: its checkpoint is a later one's."""
    config = options.complete(replace(config, epochs=epoch))
    folder = Path(config.out)
    done = records.epochs_done(folder)
    if done > epoch:
        raise UsageError(f"{folder} has {done} epochs, not {epoch}: remove it or choose an --out")
    if done < epoch:
        run.train(config, resume=(folder / "config.json").exists())
    its = restored(folder)
    return its.agent, its.original, its.replay


def figure_3(config: Config) -> dict[str, np.ndarray]:
    """Section 5.3: the variance of a random state ŝ and its action with each achieved goal of its
    own trajectory. xy (5, T+1, 2); t (5,), the step of ŝ; variance (5, T+1)."""
    agent, _, _ = trained(config, EPOCH)
    rng = np.random.default_rng(0)
    with ParallelEnvs(config.env, 16, 1) as envs:
        envs.reset(1_000_000)
        policy = run.explorer(run.actor(agent, 16, 16), rng, (50, 16, 2), 0.2, 0.3)
        episodes, _ = run.rollout(envs, policy, 50)
    length = np.linalg.norm(np.diff(episodes["obs"], axis=1), axis=-1).sum(axis=1)
    rows = np.argsort(-length)[:TRAJECTORIES]  # those that move most
    t = rng.integers(50, size=TRAJECTORIES)
    variance = []
    for row, step in zip(rows, t, strict=True):
        goals = episodes["achieved_goal"][row]
        here = [np.repeat(episodes[k][row, [step]], len(goals), axis=0) for k in ("obs", "action")]
        variance.append(agent.q_variance(*here, goals))
    return {"xy": episodes["obs"][rows], "t": t, "variance": np.stack(variance)}


def figure_5(config: Config) -> dict[str, np.ndarray]:
    """Section 5.5: states and goals, (SHOWN, 4), in B_o, in B_h and drawn from B_h by priority, at
    each stage."""
    points = {}
    for epoch in STAGES:
        _, original, her_buffer = trained(config, epoch)
        rng = np.random.default_rng(epoch)
        episodes = original.episodes
        e, t = rng.integers(original.size, size=SHOWN), rng.integers(50, size=SHOWN)
        points[f"original_{epoch}"] = np.hstack(
            [episodes["obs"][e, t], episodes["desired_goal"][e]]
        )
        i = rng.choice(her_buffer.size, SHOWN, replace=False)
        points[f"her_{epoch}"] = np.hstack([her_buffer.data[k][i] for k in ("obs", "goal")])
        drawn = her_buffer.sample(SHOWN, rng)
        points[f"drawn_{epoch}"] = np.hstack([drawn["obs"], drawn["goal"]])
        points[f"effective_{epoch}"] = np.array(effective_share(her_buffer.probabilities))
    return {name: x.astype(np.float32) for name, x in points.items()}


def figure_8(config: Config) -> dict[str, np.ndarray]:
    """Section 5.8: of every transition of B_h the variance now, the probability to be drawn, and
    whether it is hindsight's, (N,) each."""
    agent, _, her_buffer = trained(config, EPOCH)
    rows = {name: x[: her_buffer.size] for name, x in her_buffer.data.items()}
    return {
        "variance": agent.q_variance(rows["obs"], rows["action"], rows["goal"]),
        "probability": her_buffer.probabilities.astype(np.float32),
        "hindsight": rows["hindsight"],
    }


def jobs(out: Path) -> dict:
    """What is made: for each file's name the function and the run it is made from."""

    def config(name, **settings):
        return Config(**SCHEDULE, **settings, out=str(out / name))

    half = {"relabel_ratio": 0.5}  # Sections 5.4, 5.5, 5.8
    small = {**half, "buffer_size": 10_000}  # Figure 5's caption
    return {
        "fig3": (figure_3, config("heads16")),
        **{f"fig8_{k}": (figure_8, config(f"half{k}", **half, heads=k)) for k in SIZES},
        "fig5_consistency": (figure_5, config("small_consistency", **small)),
        "fig5_variance": (figure_5, config("small_variance", **small, priority="variance")),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="of the files to make (default: all)"
    )
    parser.add_argument("--out", default="runs/didactic", help="the runs (default: runs/didactic)")
    given = parser.parse_args()
    made = jobs(Path(given.out))
    if unknown := set(given.names) - made.keys():
        parser.error(f"no {', '.join(sorted(unknown))}; there are {', '.join(made)}")
    try:
        arrays = {name: made[name][0](made[name][1]) for name in given.names or made}
    except UsageError as error:
        parser.error(str(error))
    folder = RESULTS / "didactic"
    folder.mkdir(parents=True, exist_ok=True)
    for name, its in arrays.items():  # after all runs, which note whether the work tree is clean
        np.savez_compressed(folder / f"{name}.npz", **its)
        print(folder / f"{name}.npz")


if __name__ == "__main__":
    main()
