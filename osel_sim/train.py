"""`python -m osel_sim.train`: trains a policy from demonstrations, or the context encoder."""

import json
import sys
from collections.abc import Sequence

from osel_sim.api.train import EncoderTrainConfig, TrainConfig
from osel_sim.cli.command import Command

EXAMPLES = """examples:
  python -m osel_sim.train --policy local_small --data data/pick_place --out runs/train/local_small
  python -m osel_sim.train --policy local_small --data data/pick_place --out runs/train/local_small --resume
  python -m osel_sim.train --policy remote_large --data data/mine --init assets/policies/remote_large --steps 2000     (adapt it to more data)
  python -m osel_sim.train --encoder osel_small --data data/scenes     (the context encoder instead; --encoder --help tells more)
"""
ENCODER_EXAMPLES = """examples:
  python -m osel_sim.train --encoder osel_small --data data/scenes
  python -m osel_sim.train --encoder osel_small --data data/scenes --task all --level 0 1 2 --steps 3000 --out runs/train/osel_small
"""


def _execute(config: TrainConfig) -> int:
    from osel_sim.api.train import train
    from osel_sim.cli.next_step import print_next

    out, result = train(config)
    print(f"written to {out}: {result['steps']} steps in {result['training_seconds'] / 60:.1f} minutes")
    print(
        f"to drive with it, copy policies/{config.policy}.toml and say checkpoint = {json.dumps(str(out.resolve()))} in the copy (docs/policies.md)"
    )
    print_next(("shows what it sees and does", "doctor", ["--policy", "COPY.toml", "--task", result["datasets"][0]["task"]]))
    return 0


def _execute_encoder(config: EncoderTrainConfig) -> int:
    from osel_sim.api.train import train_encoder
    from osel_sim.cli.next_step import print_next

    out, result = train_encoder(config)
    print(json.dumps(result["measured"], indent=2))
    print(f"written to {out}", file=sys.stderr)  # standard output is JSON
    print_next(("uses it", "run", ["--task", *config.task, "--encoder", out]), file=sys.stderr)
    return 0


policy_command = Command("train", TrainConfig, _execute, EXAMPLES)
encoder_command = Command("train", EncoderTrainConfig, _execute_encoder, ENCODER_EXAMPLES)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; `--encoder` anywhere among the words means the encoder instead of a policy."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not any(word.partition("=")[0] == "--encoder" for word in words):
        return policy_command(words)
    at = next(index for index, word in enumerate(words) if word.partition("=")[0] == "--encoder")
    if words[at] == "--encoder" and (at + 1 == len(words) or words[at + 1].startswith("-")):
        words[at : at + 1] = []  # alone it means the only architecture there is
    return encoder_command(words)


if __name__ == "__main__":
    sys.exit(main())
