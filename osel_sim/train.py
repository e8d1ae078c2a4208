"""python -m osel_sim.train: trains a policy from demonstrations, or the context encoder."""

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

from osel_sim import cli
from osel_sim.core.errors import UsageError
from osel_sim.formats import library

EXAMPLES = """examples:
  python -m osel_sim.train --policy local_small --data data/pick_place --out runs/train/local_small
  python -m osel_sim.train --policy local_small --data data/pick_place --out runs/train/local_small --resume
  python -m osel_sim.train --policy remote_large --data data/mine --init assets/policies/remote_large --steps 2000     (adapt it to more data)
  python -m osel_sim.train --encoder osel_small --data data/scenes     (the context encoder instead; --encoder --help tells more)
"""


def parser() -> cli.Parser:
    """The command line."""
    result = cli.Parser(
        "train",
        "Train a policy on demonstrations (a LeRobotDataset, as osel_sim.collect writes it) into a LeRobot checkpoint folder. "
        "Uses a CUDA GPU where there is one.",
        EXAMPLES,
    )
    result.add_argument("--policy", metavar="NAME", required=True, help="policy file whose cameras and chunk it must fit, and whose recipe is used")
    result.add_argument(
        "--data",
        metavar="DIR",
        type=Path,
        nargs="+",
        required=True,
        help="demonstrations: LeRobotDatasets with images, not videos, one a task, or folders of such datasets",
    )
    result.add_argument("--out", metavar="DIR", type=Path, help="checkpoint folder to write (default: runs/train/NAME)")
    result.add_argument("--recipe", metavar="FILE", type=Path, help="sizes and settings (default: policies/training/NAME.toml)")
    result.add_argument("--policies-dir", metavar="DIR", type=Path, help="further policy files")
    result.add_argument("--tasks", metavar="DIR", type=Path, help="further task files, for --eval-episodes")
    budget = result.add_mutually_exclusive_group()
    budget.add_argument("--steps", type=int, help="number of steps (default: the recipe's)")
    budget.add_argument("--minutes", type=float, help="as many steps as fit into so many minutes, measured first; prefer --steps to repeat a result")
    result.add_argument("--batch-size", type=int, help="samples a step (default: the recipe's)")
    result.add_argument("--episodes", type=int, help="train on the first N episodes of each dataset only (default: the recipe's)")
    result.add_argument("--seed", type=int, default=0, help="fixes first weights, order and augmentation (default: %(default)s)")
    result.add_argument("--threads", type=int, default=0, help="processor threads (default: all cores)")
    result.add_argument("--init", metavar="DIR", type=Path, help="begin with the weights of this checkpoint folder, of the same model")
    result.add_argument("--resume", action="store_true", help="continue in --out exactly where the last saved state was")
    result.add_argument(
        "--eval-every", metavar="STEPS", type=int, default=1000, help="validate and write the checkpoint so often (default: %(default)s)"
    )
    result.add_argument(
        "--eval-episodes", metavar="N", type=int, default=0, help="episodes of each task in simulation at each validation (default: %(default)s)"
    )
    result.add_argument("--save-every", metavar="STEPS", type=int, default=500, help="save the state for --resume so often (default: %(default)s)")
    result.add_argument("--half", action="store_true", help="save the weights in half precision")
    return result


@cli.main
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if any(argument.partition("=")[0] == "--encoder" for argument in arguments):
        from osel_sim.training.encoder import train as encoder_training

        return encoder_training.main(arguments)
    return _train_policy(parser().parse_args(arguments))


def _train_policy(options: argparse.Namespace) -> int:
    from osel_sim.training.recipe import find_recipe, load_recipe

    for name, low in {
        "steps": 1,
        "batch_size": 1,
        "episodes": 1,
        "eval_every": 1,
        "save_every": 1,
        "eval_episodes": 0,
        "threads": 0,
        "seed": 0,
    }.items():
        value = getattr(options, name)
        if value is not None and value < low:
            raise UsageError(f"--{name.replace('_', '-')} must be at least {low}, got {value}")
    if options.minutes is not None and not 0 < options.minutes < 1e5:
        raise UsageError(f"--minutes must be positive, got {options.minutes}")
    for folder in options.data:
        if not folder.is_dir():
            raise UsageError(f"{folder} is not a folder of demonstrations; python -m osel_sim.collect writes one")
    spec = library.load_policy(options.policy, options.policies_dir)
    recipe = load_recipe(options.recipe or find_recipe(options.policy))
    changes = {key: getattr(options, key) for key in ("steps", "batch_size") if getattr(options, key) is not None}
    recipe = replace(recipe, optimisation=replace(recipe.optimisation, **changes), episodes=options.episodes or recipe.episodes)

    # Threads that wait by spinning waste the core another process could use; read by OpenMP when torch is first imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from osel_sim.training.policy_training import Options, train

    out = options.out or Path("runs") / "train" / spec.name
    result = train(
        spec,
        recipe,
        options.data,
        Options(
            out=out,
            seed=options.seed,
            threads=options.threads,
            minutes=options.minutes,
            resume=options.resume,
            evaluate_every=options.eval_every,
            rollouts=options.eval_episodes,
            save_every=options.save_every,
            half=options.half,
            tasks=options.tasks,
            init=options.init,
        ),
    )
    print(f"{out}: {result['steps']} steps in {result['training_seconds'] / 60:.1f} minutes")
    return 0


if __name__ == "__main__":
    sys.exit(main(None))
