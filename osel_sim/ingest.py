"""Turn outcome tables of others into a rollout log: `python -m osel_sim.ingest --map mapping.toml --out logs/theirs`."""

import sys
from typing import TYPE_CHECKING

from osel_sim.api.ingest import IngestConfig
from osel_sim.cli.command import Command

if TYPE_CHECKING:
    from osel_sim.api.ingest import IngestResult

EXAMPLES = """examples:
  # a mapping file says what the columns mean (examples/mmlu.toml)
  python -m osel_sim.ingest --map examples/mmlu.toml --out logs/mmlu
  python -m osel_sim.ingest --map examples/mmlu.toml --files 'elsewhere/mmlu_{subject}.csv' --encoder sentence:all-MiniLM-L6-v2 --out logs/mmlu

  # the same without a file: wide (a column for each policy); a part of the files' names is a column
  python -m osel_sim.ingest --files 'responses/mmlu_{subject}.csv' --text prompt --group subject --policies small large \\
      --success '{policy}' --seconds small=0.3 large=1.2 --price small=0 large=0.05 --out logs/mmlu

  # images and text, long (a row for each instance and policy)
  python -m osel_sim.ingest --files answers.parquet --key frame --image image_path --text question --policy-column model \\
      --success correct --seconds seconds --price cents --encoder ViT-L-14:openai --out logs/waymo

  # subgoals and steps
  python -m osel_sim.ingest --files episodes.jsonl --text instruction --group task_type --policy-column model --repeat-column trial \\
      --success solved --subgoals fraction --steps steps --price cents --out logs/alfred

  # other units, nested JSON
  python -m osel_sim.ingest --files answers.jsonl --text question --policy-column model --success scores.exact --seconds time_ms/1000 \\
      --price usage.usd --price-unit usd --out logs/theirs

  # what lerobot-eval or vla-eval measured, a file a policy; episodes are paired by task and seed
  python -m osel_sim.ingest --results small=runs/small/eval_info.json large=runs/large/eval_info.json --price small=0 large=12 --out logs/theirs

  # decisions that were made, with the probability of each choice: what would others have earned?
  python -m osel_sim.ingest --files requests.parquet --text prompt --policy-column model --success ok --propensity p --out logs/requests

  # minus the error of the actions that policies would have taken on logged observations (Open X-Embodiment)
  python -m osel_sim.ingest --metric action-mse --dataset data/bridge data/fractal --policies local_small remote_large --out logs/oxe

Writes rollouts.parquet and contexts.npz into --out, nothing if the table is wrong. The same command goes on with an interrupted encoding, and another
--encoder adds its contexts to the log. How a mapping file looks, and all that is taken: docs/tables.md."""


def _execute(config: IngestConfig) -> int:
    from osel_sim.api.ingest import ingest
    from osel_sim.cli.console import console
    from osel_sim.cli.next_step import print_next
    from osel_sim.cli.rollout_tables import print_rollouts

    result = ingest(config)
    weights, preset = result.weights
    for note in result.notes:
        print(note)
    print(f"{result.folder}: {len(result.rows)} rows, contexts of {result.encoder}, {result.seconds:.0f} s")
    print_rollouts(console(), result.rows, weights)
    print(f"reward ({preset}): {weights.success} - {weights.alpha_time} {weights.time_text} - {weights.alpha_price} cents")
    print(f"written to {result.folder}")
    print_next(("replays it to selectors: is routing worth it?", "replay", [result.folder, *_flags(result, preset)]))
    return 0


def _flags(result: "IngestResult", preset: str) -> list[object]:
    """Flags for a replay by the same weights, as far as the log knows what they weigh."""
    from osel_sim.api.reward import DEFAULT_PRESET

    frame = result.outcomes
    flags: list[object] = [] if preset == DEFAULT_PRESET else ["--preset", preset]
    if frame[["steps", "upload", "inference", "download", "motion"]].isna().all(axis=None):
        flags += ["--alpha-time", 0]
    return [*flags, "--alpha-price", 0] if frame["price"].isna().all() else flags


main = Command("ingest", IngestConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
