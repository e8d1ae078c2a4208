"""Training state on disk: written whole under another name, then renamed, so a kill at any moment leaves the last good one."""

import json
from pathlib import Path
from typing import Any

import torch

from osel_sim.core.errors import DataError

STATE_FILE = "training_state.pt"


def save_state(folder: Path, state: dict[str, Any]) -> None:
    """Write tensors, numbers and strings; nothing else is read back."""
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / (STATE_FILE + ".partial")
    torch.save(state, partial)
    partial.replace(folder / STATE_FILE)


def load_state(folder: Path) -> dict[str, Any] | None:
    """The last state, or None where there is none.

    Raises:
        DataError: the file is damaged or holds something else.
    """
    file = folder / STATE_FILE
    if not file.is_file():
        return None
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises pickle, zip and runtime errors alike
        raise DataError(f"{file}: cannot be read ({type(error).__name__}); remove it to start over") from None
    if not isinstance(state, dict) or "step" not in state:
        raise DataError(f"{file}: is no training state")
    return state


def write_json(file: Path, value: dict[str, Any]) -> None:
    """Write a JSON file whole or not at all."""
    partial = file.with_name(file.name + ".partial")
    partial.write_text(json.dumps(value, indent=2) + "\n")
    partial.replace(file)
