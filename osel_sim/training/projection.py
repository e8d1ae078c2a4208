"""Where things are in the training images: labels that teach a query to look at what it names.

Without them a policy can guess most positions from its own state (what it carries is where its gripper is) and never learns to look.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pinhole:
    """A camera, as a dataset's side file gives it.

    Attributes:
        mount: `world`, or `gripper` if it moves with the grip site.
        position: (3,), metres in the mount's frame.
        rotation: (3, 3), columns are the image's right and up and the direction backwards, in the mount's frame.
        fovy: vertical field of view, degrees; images are square.
    """

    mount: str
    position: Array
    rotation: Array
    fovy: float

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Pinhole":
        """Raises KeyError, TypeError or ValueError for anything else than the promised form."""
        if data["mount"] not in ("world", "gripper"):
            raise ValueError(f"mount must be world or gripper, got {data['mount']!r}")
        rotation = np.array(data["rotation"], np.float64).reshape(3, 3)
        return cls(data["mount"], np.array(data["position"], np.float64).reshape(3), rotation, float(data["fovy"]))

    def places(self, points: NDArray[np.float32], state: NDArray[np.float32]) -> NDArray[np.float32]:
        """Column and row (batch, N, 2) in [-1, 1] of world points (batch, N, 3); NaN where a point is out of view.

        Args:
            state: (batch, 8), of which the grip site's position and axis-angle are used.
        """
        from scipy.spatial.transform import Rotation

        offset = points.astype(np.float64)
        if self.mount == "gripper":
            rotation = Rotation.from_rotvec(state[:, 3:6].astype(np.float64)).as_matrix()
            offset = np.einsum("bji,bnj->bni", rotation, offset - state[:, None, :3])
        seen = (offset - self.position) @ self.rotation
        depth = -seen[..., 2] * np.tan(np.radians(self.fovy) / 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            places = np.stack([seen[..., 0], -seen[..., 1]], axis=-1) / depth[..., None]
        hidden = (depth <= 0) | (np.abs(places) > 1).any(axis=-1)
        places[hidden] = np.nan
        result: NDArray[np.float32] = places.astype(np.float32)
        return result
