"""What tells one scene from another: a digest of how an instance is set up, before anything moves.

The state after the scene has come to rest is not part of it: contacts make a difference in the last bit, such as between two kinds of CPU, one of a
tenth of a millimetre. How the scene is set up, numbers to seven decimals, is the same on both.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.files import content_digest

FIELDS = (
    "body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos", "jnt_range", "dof_damping", "dof_armature", "dof_frictionloss",
    "geom_type", "geom_contype", "geom_conaffinity", "geom_friction", "geom_pos", "geom_size", "geom_rbound", "site_pos",
    "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange",
    "geom_matid", "geom_rgba", "mat_rgba", "light_dir", "light_diffuse", "cam_pos", "cam_quat", "cam_fovy",
)  # fmt: skip
"""Arrays of the model that say what is where, what it weighs and what it looks like: all that levels perturb, and what stays the same."""
DECIMALS = 7
LENGTH = 16
"""Characters of a digest: enough that two scenes of a log never share one by chance."""


class Fingerprint:
    """Of the scenes of one model.

    Args:
        model: of MuJoCo; its textures never change.
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        self._textures: str | None = None  # tens of megabytes: looked at when first asked for

    def of(self, positions: NDArray[np.float64], instruction: str) -> str:
        """Digest of the scene that the model now shows.

        Args:
            positions: (nq,) of all joints as the instance sets them.
        """
        model = self._model
        self._textures = self._textures or content_digest(model.tex_data.tobytes())
        headlight = model.vis.headlight
        arrays = {name: getattr(model, name) for name in FIELDS} | {"positions": positions, "gravity": model.opt.gravity}
        arrays |= {"timestep": model.opt.timestep, "ambient": headlight.ambient, "diffuse": headlight.diffuse}
        told = (part for name, values in arrays.items() for part in (name, _rounded(values)))
        return content_digest(self._textures, *told, instruction)[:LENGTH]


def _rounded(values: Any) -> bytes:
    """Numbers as bytes that do not depend on their last bits, nor on the sign of a zero."""
    return (np.round(np.asarray(values, np.float64), DECIMALS) + 0.0).tobytes()
