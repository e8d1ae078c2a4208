"""What a LeRobot checkpoint's files name, looked at before anything of it is built: LeRobot imports and calls any class that they name.

`config.json` says which registered type of policy it is, and the processors' JSON which steps they are made of: by a registered name, or by the path
of a class. Weights and states are safetensors.
"""

import json
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.processor import ProcessorStep, ProcessorStepRegistry

from osel_sim.core.errors import CheckpointError, did_you_mean
from osel_sim.core.trust import ForeignCodeError, find_class

CONFIG = "config.json"
PIPELINES = ("policy_preprocessor.json", "policy_postprocessor.json")
PACKAGES = ("lerobot", "osel_sim")
MAX_BYTES = 16 << 20  # of a JSON file


def check_checkpoint(folder: Path) -> None:
    """Whether everything that the JSON files of a checkpoint name may be run.

    Args:
        folder: a checkpoint on this machine. Our own types and steps, and those of installed plugins, must have been registered.

    Raises:
        CheckpointError: naming the file, the step's number, what it names and how to allow it; also if a file is damaged.
    """
    for name, check in ((CONFIG, _check_config), *((name, _check_pipeline) for name in PIPELINES)):
        file = folder / name
        if file.exists():
            check(file, _read(file))


def _read(file: Path) -> Any:
    try:
        if file.stat().st_size > MAX_BYTES:
            raise CheckpointError(f"{file}: has {file.stat().st_size} bytes, and no more than {MAX_BYTES} are read")
        return json.loads(file.read_text())  # in the encoding in which LeRobot will read it: what is checked is what is loaded
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{file}: cannot be read as JSON ({str(error)[:120]})") from None


def _check_config(file: Path, data: Any) -> None:
    kind = data.get("type") if isinstance(data, dict) else None
    known = sorted(PreTrainedConfig.get_known_choices())
    if not isinstance(kind, str) or kind not in known:
        hint = did_you_mean(str(kind), known)
        raise CheckpointError(f"{file}: type {str(kind)[:80]!r} is no registered type of policy: {hint}known: {', '.join(known)}")


def _check_pipeline(file: Path, data: Any) -> None:
    steps = data.get("steps") if isinstance(data, dict) else None
    if not isinstance(steps, list):
        raise CheckpointError(f"{file}: 'steps' must be a list")
    for number, step in enumerate(steps):
        try:
            _check_step(step, file.parent)
        except ForeignCodeError as error:
            raise ForeignCodeError(f"{file}: step {number} {error}") from None
        except CheckpointError as error:
            raise CheckpointError(f"{file}: step {number} {error}") from None


def _check_step(step: Any, folder: Path) -> None:
    if not isinstance(step, dict) or ("registry_name" in step) == ("class" in step):
        raise CheckpointError("must be an object with either a 'registry_name' or a 'class'")
    if "class" in step:
        find_class(step["class"], PACKAGES, ProcessorStep, folder)
    else:
        name, known = step["registry_name"], ProcessorStepRegistry.list()
        if not isinstance(name, str) or name not in known:
            hint = did_you_mean(str(name), known) or "is the package that brings it installed?"
            raise CheckpointError(f"has no registered name: {str(name)[:80]!r}; {hint.strip()}")
    if not isinstance(step.get("config", {}), dict):
        raise CheckpointError("has a 'config' that is no object")
    state = step.get("state_file", "state.safetensors")
    if not isinstance(state, str) or Path(state).name != state or "\\" in state or not state.endswith(".safetensors"):
        raise CheckpointError(f"has the state file {str(state)[:80]!r}, which must be the name of a .safetensors file beside it")
