"""A plugin package with two small deterministic policies, and a short task, for tests of the commands in processes of their own."""

import contextlib
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from osel_sim.cli.command import Command
from osel_sim.core import content

PLUGIN = '''
"""Two policies without weights: they look at the picture and the instruction, and reach for nothing in particular."""

import os
import sys

import numpy as np


class Wander:
    def __init__(self, size):
        self.size = size

    def reset(self, instruction):
        self.phase, self.calls = len(instruction), 0

    def act(self, observation):
        self.calls += 1
        who = "server" if "osel_sim.serve" in " ".join(sys.orig_argv) else observation["task"]
        if os.environ.get("WANDER_DIES_ON") in (who, "everything") and self.calls == 2:
            os.kill(os.getpid(), 9)
        image = observation["observation.images.agentview"]
        drift = float(image.mean()) / 255 + float(observation["observation.state"][0])
        self.phase += 1
        steps = np.arange(12)[:, None] + np.arange(7)[None, :]
        return (self.size * np.sin(steps + self.phase + 10 * drift)).astype(np.float32)


class Colours:
    """An encoder: the mean colour of each ninth of the picture, and the letters of the instruction."""

    name = identity = "colours"
    dimension, image_size = 53, 48

    def encode(self, images, instruction):
        picture = np.mean(images, axis=0).reshape(3, 16, 3, 16, 3).mean(axis=(1, 3)).ravel() / 255
        letters = [instruction.lower().count(letter) / len(instruction) for letter in "abcdefghijklmnopqrstuvwxyz"]
        return np.array([*picture, *letters], np.float32)


def load_calm(spec, environment):
    return lambda: Wander(0.2)


def load_wild(spec, environment):
    return lambda: Wander(1.0)
'''

POLICY = """version = 1
name = "{name}"
title = "test"
location = "{location}"
kind = "{kind}"
execute = 8
inference_seconds = {inference}

[observation]
cameras = ["agentview"]
image_size = 32
"""

REMOTE = """
[remote]
network = "lte"
mode = "{mode}"
deadline = {deadline}
fallback = "calm"

[price]
per_action = 0.02
per_call = 0.1
per_megabyte = 1.0
"""

HORIZON = 30


def make_world(folder: Path, mode: str = "blocking", deadline: float = 2.0) -> Path:
    """A folder with plugin/, policies/ and tasks/: policies `calm` (local) and `wild` (remote), task `short`."""
    plugin = folder / "plugin"
    (plugin / "wander_policies-1.0.dist-info").mkdir(parents=True)
    (plugin / "wander_policies.py").write_text(PLUGIN)
    (plugin / "wander_policies-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: wander-policies\nVersion: 1.0\n")
    (plugin / "wander_policies-1.0.dist-info" / "entry_points.txt").write_text(
        "[osel_sim.policies]\n"
        "calm = wander_policies:load_calm\nwild = wander_policies:load_wild\n[osel_sim.encoders]\ncolours = wander_policies:Colours\n"
    )
    (folder / "policies").mkdir()
    (folder / "policies" / "calm.toml").write_text(POLICY.format(name="calm", location="local", kind="calm", inference=0.01))
    wild = POLICY.format(name="wild", location="remote", kind="wild", inference=0.1) + REMOTE.format(mode=mode, deadline=deadline)
    (folder / "policies" / "wild.toml").write_text(wild)
    (folder / "tasks").mkdir()
    text = content.find("tasks", "pick_place").read_text()
    text = re.sub(r'(?m)^name = "pick_place"', 'name = "short"', text)
    text = re.sub(r"(?m)^horizon = \d+", f"horizon = {HORIZON}", text)
    (folder / "tasks" / "short.toml").write_text(text)
    return folder


def command(world: Path, name: str, *arguments: object) -> list[str]:
    """Command line of `run` or `record` on the task `short` with both policies."""
    fixed = [
        "--task",
        "short",
        "--tasks",
        world / "tasks",
        "--policies-dir",
        world / "policies",
        "--policies",
        "calm",
        "wild",
        "--encoder",
        "colours",
    ]
    return [sys.executable, "-m", f"osel_sim.{name}", *map(str, fixed), *map(str, arguments)]


def environment(world: Path, **more: str) -> dict[str, str]:
    """Environment in which the plugin is installed."""
    path = os.pathsep.join([str(world / "plugin"), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **more}


def execute(world: Path, name: str, *arguments: object, **more: str) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(
        command(world, name, *arguments), env=environment(world, **more), cwd=world, capture_output=True, text=True, timeout=900, check=False
    )


def next_commands(output: str) -> list[tuple[str, object]]:
    """Name and configuration of each command that an output says to type next; their flags exist, and so do their folders."""
    found = []
    for line in output[output.rindex("next: ") :].splitlines():
        words = shlex.split(line.removeprefix("next: "), comments=True)
        name = words[words.index("-m") + 1].removeprefix("osel_sim.")
        command = import_module(f"osel_sim.{name}").main

        def keep(config: object, name: str = name) -> int:
            found.append((name, config))
            return 0

        assert Command(name, command.config, keep, "")(words[words.index("-m") + 2 :]) == 0, line
    return found


def wait_for_lines(process: subprocess.Popen, file: Path, lines: int) -> None:
    """Wait until a command has written so many lines."""
    end = time.monotonic() + 600
    while not (file.exists() and file.read_bytes().count(b"\n") >= lines):
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < end
        time.sleep(0.02)


def children(process: subprocess.Popen) -> set[int]:
    """Process ids of what a process started from its main thread and has not buried."""
    return _children(process.pid)


def _children(pid: int) -> set[int]:
    with contextlib.suppress(FileNotFoundError):  # it has ended
        return set(map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()))
    return set()


def started(process: subprocess.Popen) -> set[int]:
    """Process ids of those, and of what they started themselves."""
    direct = children(process)
    return direct.union(*(_children(pid) for pid in direct))


def wait_until(condition: Callable[[], object], seconds: float) -> bool:
    """Whether a condition is met in time."""
    end = time.monotonic() + seconds
    while not (met := condition()) and time.monotonic() < end:
        time.sleep(0.005)
    return bool(met)
