"""Two policies for the toy suite: one goes to whatever goal is near, the other reads the instruction. Both look at the picture only."""

import numpy as np

COLOURS = {"red": (220, 40, 40), "green": (40, 180, 60), "blue": (40, 80, 220)}


class Seeker:
    """Heads for a goal that it sees.

    Args:
        dimension: numbers of an action.
        reads: whether it cares which goal it was told to go to.
    """

    def __init__(self, dimension, reads):
        self.dimension, self.reads = dimension, reads

    def reset(self, instruction):
        self.instruction = instruction

    def act(self, observation):
        picture, point = observation["observation.images.top"].astype(int), observation["observation.state"]
        wanted = [rgb for name, rgb in COLOURS.items() if name in self.instruction or not self.reads]
        pixels = [np.argwhere(np.abs(picture - rgb).sum(axis=2) < 90) for rgb in wanted]
        places = [found.mean(axis=0)[::-1] / (len(picture) - 1) for found in pixels if len(found)]
        nearest = min(places, key=lambda place: np.linalg.norm(place - point), default=point)
        chunk = np.zeros((4, self.dimension), np.float32)
        chunk[:] = np.clip((nearest - point) / 0.2, -1.0, 1.0)
        return chunk


def load_greedy(spec, environment):
    return lambda: Seeker(environment.action.dimension, reads=False)


def load_reader(spec, environment):
    return lambda: Seeker(environment.action.dimension, reads=True)
