"""Set before any test imports a library: no network, and one thread a process, because the tests run in several."""

import os
import sys

os.environ["HF_HUB_OFFLINE"] = "1"
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Byte code of the tests is kept whatever PYTHONDONTWRITEBYTECODE says: to rewrite their assertions takes each process seconds.
sys.dont_write_bytecode = False
