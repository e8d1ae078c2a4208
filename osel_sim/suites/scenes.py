"""Digests of the scenes of other suites, as `osel_sim.sim.fingerprint` makes them of ours.

Their resets may let things come to rest, which differs between machines in the last bits: joints count to a tenth of a millimetre (or milliradian).
"""

import json
import sys
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.files import content_digest
from osel_sim.sim.fingerprint import LENGTH, Fingerprint
from osel_sim.suites.base import PlainInstance

DECIMALS = 4


def of_mujoco(fingerprint: Fingerprint, positions: NDArray[np.float64], instance: PlainInstance) -> str:
    """Digest of a scene in MuJoCo.

    Args:
        fingerprint: of its model.
        positions: (nq,) of all joints, as it was reset to.
    """
    return fingerprint.of(np.round(positions, DECIMALS), _told(instance))


def of_numbers(parts: Iterable[tuple[str, NDArray[np.float64]]], instance: PlainInstance) -> str:
    """Digest of a scene of which only observed numbers are known; empty where there are none."""
    rows = [(name, (np.round(values, DECIMALS) + 0.0).tobytes()) for name, values in parts]
    return content_digest(*(part for row in rows for part in row), _told(instance))[:LENGTH] if rows else ""


def mujoco_of(env: Any) -> tuple[Any, Any] | None:
    """MuJoCo's model and data within a gymnasium environment: gymnasium's own, dm_control's, robosuite's; None where there are none."""
    mujoco = sys.modules.get("mujoco")  # an environment that is simulated by it has imported it
    if mujoco is None:
        return None
    inner = getattr(env, "_env", None)
    physics, simulation = getattr(inner, "physics", None), getattr(getattr(inner, "env", None), "sim", None)
    places = [(env, "model", "data"), (env, "_model", "_data"), (physics, "model", "data"), (simulation, "model", "data")]
    for place, model_name, data_name in places:
        model, data = (_bare(getattr(place, name, None)) for name in (model_name, data_name))
        if isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData):
            return model, data
    return None


def _bare(value: Any) -> Any:
    """MuJoCo's own object in the wrapper of dm_control (`ptr`) or robosuite (`_model`, `_data`)."""
    for name in ("ptr", "_model", "_data"):
        value = getattr(value, name, value)
    return value


def _told(instance: PlainInstance) -> str:
    details: Mapping[str, Any] = instance.details
    return json.dumps([instance.instruction, details], sort_keys=True, default=str)
