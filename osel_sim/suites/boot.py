"""Started by the Python of a suite's own environment: finds this package, and nothing else that is installed beside it, and serves.

python -I boot.py SUITE READY_FD
"""

import importlib.util
import sys
from pathlib import Path


def _find_package() -> None:
    """Import `osel_sim` from where this file lies. Its folder stays off the path: what is installed there has the wrong versions."""
    folder = Path(__file__).resolve().parents[1]
    spec = importlib.util.spec_from_file_location("osel_sim", folder / "__init__.py", submodule_search_locations=[str(folder)])
    if spec is None or spec.loader is None:
        raise ImportError(f"no package in {folder}")
    module = importlib.util.module_from_spec(spec)
    sys.modules["osel_sim"] = module
    spec.loader.exec_module(module)


if __name__ == "__main__":
    _find_package()
    from osel_sim.suites.host import serve

    serve(sys.argv[1], int(sys.argv[2]))
