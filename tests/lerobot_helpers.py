"""LeRobot's own commands, with our plugin installed beside the checkout."""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PLUGIN = ROOT / "plugins" / "lerobot_env_osel_sim"


def install_plugin(folder: Path) -> Path:
    """Install the plugin's package into a folder, with what is installed: no network."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-build-isolation", "--target", str(folder)]
    subprocess.run([*command, str(PLUGIN)], check=True, timeout=300)
    return folder


def lerobot(command: str, plugins: Sequence[Path], folder: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run `lerobot-COMMAND` in a folder, with the packages of other folders."""
    places = os.pathsep.join(map(str, [*plugins, ROOT]))
    environment = {**os.environ, "PYTHONPATH": places, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1", "HF_HOME": str(folder / "hf")}
    code = f"from lerobot.scripts.lerobot_{command} import main; main()"
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=folder, env=environment, timeout=540)
