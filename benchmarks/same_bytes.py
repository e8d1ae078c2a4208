"""Do the same seeds give the same bytes as another revision? Runs the same commands in both trees and compares what they write.

python benchmarks/same_bytes.py 8fc9db2          # some ten minutes on two cores
python benchmarks/same_bytes.py main --only replay collect
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAIR = ["--policies", "local_small", "remote_large"]
COMMANDS: dict[str, list[str]] = {
    "run": ["run", "--task", "pick_place", *PAIR, "--counterfactual", "--episodes", "3"],
    "auto": [
        *("run", "--task", "all", *PAIR, "--level", "0", "2", "--selector", "auto", "--encoder", "osel_suite"),
        *("--action-noise", "0.05", "--episodes", "4"),
    ],
    "record": ["record", "--task", "lift", "pick_place", "--instances", "2", "--repeats", "2", *PAIR, "scripted_expert"],
    "replay": [
        *("replay", "assets/logs/pick_place", "--selectors", "ppo", "ppo_tuned", "auto", "linucb", "lints", "thompson", "ucb1", "epsilon_greedy"),
        *("--seeds", "2", "--decisions", "150", "--no-frontier"),
    ],
    "half": [
        "replay",
        "assets/logs/suite",
        "--half",
        "score",
        "--selectors",
        "auto",
        "auto:warm",
        "--seeds",
        "1",
        "--decisions",
        "200",
        "--no-frontier",
    ],
    "collect": ["collect", "--task", "lift", "--episodes", "2", "--workers", "1"],
}
COMPARED = (
    "episodes.jsonl",
    "counterfactual.jsonl",
    "contexts.npz",
    "selector.safetensors",
    "rollouts.parquet",
    "choices.npz",
    "*.csv",
    "data/**/*.parquet",
)
"""Not run.json, replay.json and the pages: they may say more than they did."""


def digests(folder: Path) -> dict[str, str]:
    files = sorted({file for pattern in COMPARED for file in folder.glob(pattern)})
    return {file.relative_to(folder).as_posix(): hashlib.sha256(_content(file)).hexdigest()[:12] for file in files}


def _content(file: Path) -> bytes:
    """The bytes of a file; of safetensors with the header's keys in order, which that library's own hash map shuffles from process to process."""
    raw = file.read_bytes()
    if file.suffix != ".safetensors":
        return raw
    size = int.from_bytes(raw[:8], "little")
    return json.dumps(json.loads(raw[8 : 8 + size]), sort_keys=True).encode() + raw[8 + size :]


def execute(tree: Path, name: str, out: Path) -> dict[str, str]:
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    done = subprocess.run(
        [sys.executable, "-m", f"osel_sim.{COMMANDS[name][0]}", *COMMANDS[name][1:], "--out", str(out)],
        cwd=tree, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        sys.exit(f"{name} in {tree}: exit code {done.returncode}\n{done.stderr[-2000:]}")
    return digests(out)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revision", help="commit to compare the working tree with")
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    options = parser.parse_args()
    different = 0
    with tempfile.TemporaryDirectory() as folder:
        old = Path(folder) / "tree"
        subprocess.run(["git", "-C", str(ROOT), "worktree", "add", "--detach", "--quiet", str(old), options.revision], check=True)
        try:
            for name in options.only:
                before, now = (execute(tree, name, Path(folder) / f"{name}-{which}") for which, tree in (("old", old), ("new", ROOT)))
                for file in sorted({*before, *now}):
                    same = before.get(file) == now.get(file)
                    different += not same
                    print(f"{name:8} {file:40} {before.get(file, '-'):12} {now.get(file, '-'):12} {'same' if same else 'DIFFERENT'}", flush=True)
        finally:
            subprocess.run(["git", "-C", str(ROOT), "worktree", "remove", "--force", str(old)], check=True)
    print("all bytes are the same" if not different else f"{different} files differ")
    return int(bool(different))


if __name__ == "__main__":
    sys.exit(main())
