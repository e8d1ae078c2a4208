"""Demonstrations of a flat world: coloured squares whose place in the image gives their place in the world."""

import json
import math
from pathlib import Path

import numpy as np

COLOURS = {
    "can": (220, 40, 40),
    "milk": (40, 80, 230),
    "bread": (230, 190, 60),
    "lemon": (60, 220, 60),
    "basket": (150, 60, 190),
    "tray": (240, 240, 240),
}
NAMES = {
    "can": ["can", "soda can"],
    "milk": ["milk", "milk carton"],
    "bread": ["bread", "loaf"],
    "lemon": ["lemon"],
    "basket": ["basket"],
    "tray": ["tray"],
}
ROLES = ["object"] * 4 + ["container"] * 2
PHRASINGS = ["put the {object} in the {container}", "move the {object} into the {container}", "the {container} should hold the {object}"]
HELD_OUT = ["kindly place our {object} inside that {container} over there", "into the {container} goes the {object}"]
SIZE = 48
STEPS = 12  # an episode
STRIDE = 0.05  # metres the largest action moves: few episodes have time left at their end, when the right action is none
REACH = 0.4  # metres from the middle of the image to its edge


def world_to_pixel(position: np.ndarray) -> np.ndarray:
    return (position[..., :2] / REACH + 1) / 2 * SIZE


def render(positions: np.ndarray, present: np.ndarray, gripper: np.ndarray) -> np.ndarray:
    image = np.full((SIZE, SIZE, 3), 90, np.uint8)
    for index, colour in enumerate(COLOURS.values()):
        if present[index]:
            _square(image, world_to_pixel(positions[index]), 4 if ROLES[index] == "object" else 6, colour)
    _square(image, world_to_pixel(gripper), 2, (10, 10, 10))
    return image


def _square(image: np.ndarray, centre: np.ndarray, half: int, colour: tuple[int, int, int]) -> None:
    column, row = np.round(centre).astype(int)
    image[max(row - half, 0) : row + half, max(column - half, 0) : column + half] = colour


def scene(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (6, 3), present (6,), target (object, container)."""
    cells = random.permutation(9)[:6]
    grid = np.stack([cells % 3 - 1, cells // 3 - 1], axis=1) * 0.24
    positions = np.concatenate([grid + random.uniform(-0.03, 0.03, (6, 2)), np.full((6, 1), 0.8)], axis=1).astype(np.float32)
    target = np.array([random.integers(4), 4 + random.integers(2)])
    present = np.ones(6, bool)
    present[random.integers(4)] = False
    present[target] = True
    return positions, present, target


def instruction(target: np.ndarray, phrasings: list[str], random: np.random.Generator) -> str:
    names = list(COLOURS)
    pick = [random.choice(NAMES[names[index]]) for index in target]
    return str(random.choice(phrasings)).format(object=pick[0], container=pick[1])


def state_of(gripper: np.ndarray, closed: float) -> np.ndarray:
    return np.concatenate([gripper, [3.1, 0.05, 0.0], [0.04 * (1 - closed), -0.04 * (1 - closed)]]).astype(np.float32)


def write(folder: Path, episodes: int, seed: int = 0, cameras: tuple[str, ...] = ("agentview",), annotated: bool = True) -> Path:
    """Write a LeRobotDataset of the schema `osel_sim.collect` writes."""
    from lerobot.datasets import LeRobotDataset

    features = {
        f"observation.images.{camera}": {"dtype": "image", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]} for camera in cameras
    }
    widths = {"observation.state": 8, "action": 7}
    if annotated:
        widths |= {"annotation.entity_positions": 18, "annotation.entity_present": 6, "annotation.noise": 1}
        features["annotation.target"] = {"dtype": "int64", "shape": (2,), "names": None}
    features |= {name: {"dtype": "float32", "shape": (width,), "names": None} for name, width in widths.items()}
    dataset = LeRobotDataset.create("local/synthetic", 20, features, root=folder, use_videos=False)
    random = np.random.default_rng(seed)
    for _ in range(episodes):
        positions, present, target = scene(random)
        text = instruction(target, PHRASINGS, random)
        gripper = np.array([*random.uniform(-0.3, 0.3, 2), 0.8], np.float32)
        closed = False
        for _ in range(STEPS):
            was_closed = closed
            goal = positions[target[int(closed)]]
            closed = closed or float(np.abs(goal - gripper).max()) < 0.01  # all of it can be seen: nothing depends on a hidden clock
            goal = positions[target[int(closed)]]
            action = np.concatenate([np.clip((goal - gripper) / STRIDE, -1, 1), np.zeros(3), [2.0 * closed - 1]]).astype(np.float32)
            frame = {
                **{f"observation.images.{camera}": render(positions, present, gripper) for camera in cameras},
                "observation.state": state_of(gripper, float(was_closed)),
                "action": action,
                "task": text,
            }
            if annotated:
                frame |= {
                    "annotation.entity_positions": positions.reshape(-1),
                    "annotation.entity_present": present.astype(np.float32),
                    "annotation.target": target.astype(np.int64),
                    "annotation.noise": np.zeros(1, np.float32),
                }
            dataset.add_frame(frame)
            gripper = gripper + STRIDE * action[:3]
        dataset.save_episode()
    dataset.finalize()
    if annotated:
        entities = [{"name": name, "role": role, "names": NAMES[name]} for name, role in zip(COLOURS, ROLES, strict=True)]
        # seen from a metre below: columns grow with x, rows with y, and all things are 0.8 high
        below = {
            "mount": "world",
            "position": [0, 0, -0.2],
            "rotation": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
            "fovy": 2 * math.degrees(math.atan(REACH)),
        }
        side = {"entities": entities, "phrasings": {"train": PHRASINGS}, "task": "pick_place", "cameras": dict.fromkeys(cameras, below)}
        (folder / "meta" / "osel_sim.json").write_text(json.dumps(side))
    return folder
