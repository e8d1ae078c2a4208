"""Simulation-in-the-loop evaluation of online foundation-model selection in robotics.

```python
import osel_sim as osel

result = osel.run(task="pick_place", policies=["local_small", "remote_large"], selector="auto", episodes=20)
result.decisions  # a pandas frame, a row a decision
```

Everything here is imported when it is first used.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from osel_sim.core import this_python

if TYPE_CHECKING:
    from osel_sim.api.collect import CollectConfig, collect
    from osel_sim.api.compare import CompareConfig, compare
    from osel_sim.api.ingest import IngestConfig, ingest
    from osel_sim.api.merge import MergeConfig, merge
    from osel_sim.api.parts import load_log, load_policy, make_env, make_selector
    from osel_sim.api.record import record
    from osel_sim.api.record_settings import RecordConfig
    from osel_sim.api.replay import replay
    from osel_sim.api.replay_settings import ReplayConfig
    from osel_sim.api.report import ReportConfig, report
    from osel_sim.api.run import run
    from osel_sim.api.run_settings import RunConfig
    from osel_sim.core.errors import OselError
    from osel_sim.policy.objects import as_policy
    from osel_sim.selection.base import SelectorBase

if getattr(sys, "argv", [])[:1] == ["-m"]:  # what it is while `python -m osel_sim.COMMAND` looks for the command
    this_python.check()

_PLACES = {
    "CollectConfig": "api.collect",
    "CompareConfig": "api.compare",
    "IngestConfig": "api.ingest",
    "MergeConfig": "api.merge",
    "OselError": "core.errors",
    "RecordConfig": "api.record_settings",
    "ReplayConfig": "api.replay_settings",
    "ReportConfig": "api.report",
    "RunConfig": "api.run_settings",
    "SelectorBase": "selection.base",
    "as_policy": "policy.objects",
    "collect": "api.collect",
    "compare": "api.compare",
    "ingest": "api.ingest",
    "load_log": "api.parts",
    "load_policy": "api.parts",
    "make_env": "api.parts",
    "make_selector": "api.parts",
    "merge": "api.merge",
    "record": "api.record",
    "replay": "api.replay",
    "report": "api.report",
    "run": "api.run",
}

__all__ = [
    "CollectConfig",
    "CompareConfig",
    "IngestConfig",
    "MergeConfig",
    "OselError",
    "RecordConfig",
    "ReplayConfig",
    "ReportConfig",
    "RunConfig",
    "SelectorBase",
    "as_policy",
    "collect",
    "compare",
    "ingest",
    "load_log",
    "load_policy",
    "make_env",
    "make_selector",
    "merge",
    "record",
    "replay",
    "report",
    "run",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'osel_sim' has no attribute {name!r}")
    import_module("osel_sim.core.caches").prepare()
    try:
        return getattr(import_module(f"osel_sim.{_PLACES[name]}"), name)
    except (ModuleNotFoundError, SyntaxError):
        found = this_python.problem()
        if found:
            raise ImportError(found) from None
        raise


def __dir__() -> "list[str]":
    return sorted([*globals(), *_PLACES])


class _Package(ModuleType):
    """This package. Importing the command `osel_sim.run` would set the attribute `run` to that module; here it stays the function."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _PLACES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
