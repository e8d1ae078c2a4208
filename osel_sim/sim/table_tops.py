"""Other table tops: robosuite's pictures of wood, felt, clay and the like, made small and compiled into every scene beside its own table.

A perturbed instance only points the table at another material, so nothing is compiled again.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import ContentError
from osel_sim.sim.kept import kept

SIZE = 256
"""Pixels, square: a table top is never larger in an image."""
OF_LEVEL: dict[int, tuple[str, ...]] = {
    1: ("gray-plaster", "gray-woodgrain", "cream-plaster"),
    2: ("light-wood", "gray-felt", "clay", "yellow-plaster", "green-wood"),
    3: ("dark-wood", "wood-tiles", "blue-wood", "wood-varnished-panels"),
}
"""Level of the axis `texture` -> names of robosuite's textures: near to its own table in colour, then further, then dark and patterned."""


def material(name: str) -> str:
    """Name of a table top's material in the model."""
    return f"table_{name}"


def add_tables(spec: Any) -> None:
    """Add all table tops to a `mujoco.MjSpec`; those of its own keep their numbers."""
    import mujoco

    for name, picture in _pictures().items():
        texture = spec.add_texture(name=material(name), type=mujoco.mjtTexture.mjTEXTURE_CUBE, width=SIZE, height=SIZE, nchannel=3)
        texture.data = picture.tobytes()
        own = spec.add_material(name=material(name), specular=0.2, reflectance=0.0)
        own.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = material(name)


@cache
def _pictures() -> dict[str, NDArray[np.uint8]]:
    """Table top -> its picture, (SIZE, SIZE, 3). To read robosuite's, which are large, would take half of the time in which a scene is opened."""
    import cv2
    import robosuite

    names = [name for own in OF_LEVEL.values() for name in own]
    folder = robosuite.__path__[0] + "/models/assets/textures/"

    def small() -> dict[str, NDArray[np.uint8]]:
        found = {}
        for name in names:
            picture = cv2.imread(folder + name + ".png", cv2.IMREAD_COLOR_RGB)
            if picture is None:
                raise ContentError(folder, name + ".png", "robosuite lacks this texture; install the version that pyproject.toml pins")
            found[name] = np.asarray(cv2.resize(picture, (SIZE, SIZE), interpolation=cv2.INTER_AREA), np.uint8)
        return found

    return kept("table_tops", f"{SIZE} {' '.join(names)} {cv2.__version__} {robosuite.__version__}", small)
