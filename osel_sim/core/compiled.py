"""numba's `njit`, imported when there is a folder for what it compiles: it looks for one but once."""

from osel_sim.core.caches import prepare

prepare()

from numba import njit as njit  # noqa: E402
