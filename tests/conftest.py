"""Set before any test imports a library: no network, and one thread a process, because the tests run in several."""

import os

os.environ["HF_HUB_OFFLINE"] = "1"
os.environ.setdefault("OMP_NUM_THREADS", "1")
