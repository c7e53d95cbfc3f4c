"""What has become of the networks: python -m experiments.plasticity DIR...

For the last checkpoint of each run and 4,096 transitions of its B_o: the shares of the units where
the trunks end, and of those of the heads' hidden layers, that are 0 for every one of the
transitions, "dead", which learn no more.
"""

import sys
from pathlib import Path

import numpy as np
import torch

from ensemble import MultiHeadMLP, linear
from envs_point import UsageError
from experiments.checkpoints import restored
from experiments.figures import label


@torch.no_grad()
def hidden(net: MultiHeadMLP, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the trunk ends, (1, B, H), and the heads' hidden layers, (K, B, H), for x (B, I)."""
    w1, b1, w2, b2 = net.trunk
    embedding = linear(linear(x, w1, b1).relu(), w2, b2).relu()
    return embedding[None], linear(embedding, *net.heads[:2]).relu()


def dead_share(units: torch.Tensor) -> float:
    """The share of units that are 0 for all of the B inputs: (K, B, H) -> a number."""
    return (units.amax(dim=1) == 0).float().mean().item()


def main(folders: list[str]) -> None:
    if not folders:
        sys.exit("usage: python -m experiments.plasticity DIR...")
    print("| run | epoch | dead: actor's trunk | actors' heads | critic's trunk | critics' heads |")
    print("|---|---|---|---|---|---|")
    for folder in map(Path, folders):
        its = restored(folder)
        agent, episodes = its.agent, its.original.episodes
        rng = np.random.default_rng(0)
        e, t = (rng.integers(n, size=4096) for n in episodes["action"].shape[:2])
        state = agent._state(episodes["obs"][e, t], episodes["desired_goal"][e])
        action = agent._tensor(episodes["action"][e, t])
        layers = hidden(agent.actor, state) + hidden(agent.critic, torch.cat([state, action], 1))
        shares = " | ".join(f"{dead_share(units):.0%}" for units in layers)
        print(f"| {its.config.env}, {label(its.config)} | {its.epoch} | {shares} |")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UsageError as error:
        sys.exit(f"plasticity.py: {error}")
