"""Imports what environments of ours need, as far as it neither draws nor starts a thread, for processes that are forked from this one.

MuJoCo and robosuite are not among it: with `MUJOCO_GL=egl` to import them opens a display.
"""

import cv2  # noqa: F401
import gymnasium  # noqa: F401
import scipy.spatial.transform  # noqa: F401

import osel_sim.sim.env  # noqa: F401
from osel_sim.sim.osc import prepare

prepare()
