"""HER by itself (Andrychowicz et al., 2017), and what the other methods' replays share with it."""

import numpy as np

from her import Batch, EpisodeBuffer


def goal_part(env_name: str) -> slice:
    """The numbers of a goal that CHER and DTGSH compare. Where the task is to rotate an object, its
    orientation alone counts, as in the originals."""
    rotates = env_name.startswith("HandManipulate") and "Rotate" in env_name
    return slice(3 if rotates else 0, None)


class HERReplay:
    """HER by itself (`--method her`): mini-batches straight from B_o, relabelled as they are drawn.

    The replays in baselines/ differ from it in `draw`, and in what they note of new episodes.
    at_once: how many mini-batches one `draw` makes. Nothing they depend on changes within a cycle,
        so that this is a matter of speed alone; a divisor of those a cycle takes leaves none over.
    """

    def __init__(self, buffer: EpisodeBuffer, at_once: int = 1):
        self.buffer, self.at_once, self._left = buffer, at_once, 0
        self.data: Batch = {}  # what was drawn last, at_once mini-batches
        self.size = 0  # its rows

    def new_episodes(self, slots: np.ndarray) -> None:
        """B_o has new episodes in the rows `slots`: what was drawn without them is dropped."""
        self._left = 0

    def draw(self, count: int, batch_size: int, rng: np.random.Generator) -> Batch:
        """`count` mini-batches, one after the other in arrays of count·batch_size rows."""
        return self.buffer.sample(count * batch_size, rng)

    def sample(self, batch_size: int, rng: np.random.Generator) -> Batch:
        """The next mini-batch, with a "weight" of 1 for each transition."""
        if not self._left:
            self.data = self.draw(self.at_once, batch_size, rng)
            self._left, self.size = self.at_once, self.at_once * batch_size
        first = (self.at_once - self._left) * batch_size
        self._left -= 1
        rows = slice(first, first + batch_size)
        batch = {name: x[rows] for name, x in self.data.items()}
        return {**batch, "weight": np.ones(batch_size, np.float32)}

    def state_dict(self) -> dict:
        return {}  # all of it follows from B_o

    def load_state_dict(self, state: dict) -> None:
        self.new_episodes(np.arange(self.buffer.size))
