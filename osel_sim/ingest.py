"""Turn outcome tables of others into a rollout log: `python -m osel_sim.ingest --map mapping.toml --out logs/theirs`."""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from osel_sim import cli
from osel_sim.core.errors import UsageError
from osel_sim.ingestion.columns import VALUES

if TYPE_CHECKING:
    from osel_sim.formats.rollout_log import Row
    from osel_sim.ingestion.columns import Columns

METRICS = ("table", "action-mse")
PRESETS = ("mmlu", "waymo", "alfred", "oxe")  # the weights themselves: osel_sim.selection.reward
TABLE_FLAGS = ("text", "image", "group", "key", "policy_column", "repeat_column", "duplicates", "name", *VALUES)

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

  # minus the error of the actions that policies would have taken on logged observations (Open X-Embodiment)
  python -m osel_sim.ingest --metric action-mse --dataset data/bridge data/fractal --policies local_small remote_large --out logs/oxe

Writes rollouts.parquet and contexts.npz into --out, nothing if the table is wrong. The same command goes on with an interrupted encoding, and another
--encoder adds its contexts to the log. How a mapping file looks: the top of osel_sim/ingestion/columns.py."""


@cli.main
def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit code."""
    options = parser().parse_args(arguments)
    if options.out is None:
        raise UsageError("--out is missing: give the folder to write to")
    if options.metric == "action-mse":
        _refuse(options, (*TABLE_FLAGS, "map", "files"), "--metric action-mse")
        return _action_mse(options)
    _refuse(options, ("dataset", "policies_dir", "camera"), "a table; add --metric action-mse for a LeRobotDataset")
    return _table(options)


def parser() -> cli.Parser:
    """Flags of the command."""
    result = cli.Parser("ingest", "Turn outcome tables of others into a rollout log with contexts.", EXAMPLES)
    add = result.add_argument
    add("--out", type=Path, metavar="DIR", help="where to write")
    add("--map", type=Path, metavar="FILE", help="mapping file; it alone says what the columns mean")
    add("--files", nargs="+", metavar="FILE", help="tables: .csv, .tsv, .jsonl or .parquet; * stands for anything, {NAME} makes a column of it")
    add("--encoder", metavar="NAME", help=f"{_encoders()} (default: tfidf, and with images osel_small+tfidf)")
    add("--device", default="cpu", help="torch device of the encoder; on another than %(default)s the last bits may differ")
    add("--preset", choices=PRESETS, help="weights of the summary's rewards (default: mmlu, with action-mse oxe)")
    table = result.add_argument_group("columns of the tables, instead of --map (a column's name; numbers hold for every row)")
    add = table.add_argument
    add("--name", help="what the log is called; the task of instances without --group (default: the name of --out)")
    add("--text", metavar="COLUMN", help="question or instruction: a column, or a template such as '{question} A. {a} B. {b}'")
    add("--image", nargs="+", metavar="COLUMN", help="paths of images, relative to the table")
    add("--group", metavar="COLUMN", help="what the log calls the task, such as a question's subject")
    add("--key", metavar="COLUMN", help="identifies an instance (default: its text, images and group)")
    add("--policies", nargs="+", metavar="NAME", help="of a wide table, or those a long one may have; with action-mse those to run")
    add("--policy-column", metavar="COLUMN", help="says that the table is long, and where it names the policy")
    add("--repeat-column", metavar="COLUMN", help="numbers repeats of a policy on an instance from 0 on")
    add("--duplicates", choices=("refuse", "drop", "repeats", "keep"), help="a second row of the same instance (default: refuse)")
    for value in VALUES:
        add(f"--{value}", nargs="+", metavar="VALUE", help=_HELP[value])
    add("--at-least", type=float, metavar="X", help="--success is a number of so much or more")
    data = result.add_argument_group("a LeRobotDataset, with --metric action-mse")
    add = data.add_argument
    add("--metric", choices=METRICS, default="table", help="read outcomes from a table, or measure them on logged actions (default: %(default)s)")
    add("--dataset", nargs="+", type=cli.folder, metavar="DIR", help="LeRobotDatasets; each one's folder name is a task of the log")
    add(
        "--camera",
        nargs="+",
        metavar="CAMERA=COLUMN",
        help="the dataset's column of a policy's camera (default: observation.images.CAMERA)",
    )
    add("--frames", type=cli.positive_int, metavar="N", help="frames of each episode, evenly spread; each is an instance (default: 4)")
    add("--tolerance", type=cli.non_negative_float, metavar="MSE", help="success is an error of so much or less (default: 0.05)")
    add("--policies-dir", type=cli.folder, metavar="DIR", help="folder with policy files of your own")
    return result


_HELP = {
    "success": "column of true and false, 1 and 0; VALUE here and below: a column, a number, or POLICY=VALUE; {policy} stands for the name",
    "score": "a graded outcome, higher is better",
    "subgoals": "fraction of the subgoals reached",
    "steps": "steps of the robot",
    "seconds": "total, where its parts are not known",
    "upload": "seconds",
    "inference": "seconds",
    "download": "seconds",
    "motion": "seconds",
    "price": "cents",
    "error": "why there is no valid outcome; empty where there is one",
}


def _encoders() -> str:
    return "tfidf, sentence:MODEL, MODEL:TAG of open_clip, a folder, or with images also A+tfidf and A+sentence:MODEL"


def _refuse(options: argparse.Namespace, names: Sequence[str], with_what: str) -> None:
    for name in names:
        if getattr(options, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} does not go with {with_what}")


def _table(options: argparse.Namespace) -> int:
    from osel_sim.context.encoder import DEFAULT_ENCODER
    from osel_sim.context.text_encoders import TFIDF, load_log_encoder
    from osel_sim.ingestion.convert import convert
    from osel_sim.ingestion.readers import read_tables
    from osel_sim.ingestion.write import Instance, check_out, file_digest, load_image, write_log

    _refuse(options, ("frames", "tolerance"), "a table; add --metric action-mse for a LeRobotDataset")
    start = time.perf_counter()
    columns = _columns(options)
    records = read_tables(columns)
    converted = convert(columns, records)
    instances = []
    for source in converted.sources:
        for image in source.images:
            load_image(image, source.record.where)  # a broken one is found before an hour of encoding, not after
        instances.append(
            Instance(
                source.key,
                source.text,
                " ".join(file_digest(image) for image in source.images),
                lambda source=source: [load_image(image, source.record.where) for image in source.images],  # type: ignore[misc]
            )
        )
    inputs = check_out(options.out, instances)
    print(f"{len(records)} rows: {len(instances)} instances, {len(converted.policies)} policies, {len(converted.rows)} outcomes")
    if converted.dropped:
        print(f"{converted.dropped} duplicate rows left out, {converted.differing or 'none'} of which differed from the row that was kept")
    name = options.encoder or (f"{DEFAULT_ENCODER}+{TFIDF}" if columns.images else TFIDF)
    files = sorted({record.file for record in records})
    metadata = {
        "task": columns.name,
        "policies": converted.policies,
        "source": {"metric": "table", "files": {file.name: file_digest(file) for file in files}},
    }
    texts = [item.text for item in instances]
    identity = write_log(
        options.out, inputs, converted.rows, instances, lambda: load_log_encoder(name, texts, bool(columns.images), options.device), metadata
    )
    return _finish(options.out, converted.rows, "table", options.preset or "mmlu", identity, start)


def _action_mse(options: argparse.Namespace) -> int:
    from osel_sim.context.encoder import DEFAULT_ENCODER
    from osel_sim.context.text_encoders import TFIDF, load_log_encoder
    from osel_sim.episodes.drivers import choose_policies
    from osel_sim.ingestion.action_mse import Settings, measure, open_datasets
    from osel_sim.ingestion.write import check_out, write_log

    start = time.perf_counter()
    if not options.dataset:
        raise UsageError("--dataset is missing: give the folder of a LeRobotDataset")
    specs = choose_policies(options.policies, options.policies_dir)
    cameras = {}
    for item in options.camera or []:
        camera, equals, column = item.partition("=")
        if not (camera and equals and column):
            raise UsageError(f"--camera must be CAMERA=COLUMN, got {item!r}")
        cameras[camera] = column
    settings = Settings(options.frames or 4, 0.05 if options.tolerance is None else options.tolerance, cameras)
    samples = open_datasets(options.dataset, specs, settings)
    instances = [sample.instance for sample in samples]
    inputs = check_out(options.out, instances)
    rows, source = measure(samples, specs, settings)
    # By `metric`, replay and report know that what counts is the score.
    metadata = {"task": "action-mse", "policies": [spec.name for spec in specs], "source": {"metric": "action-mse", **source}}
    texts = [item.text for item in instances]
    name = options.encoder or f"{DEFAULT_ENCODER}+{TFIDF}"
    identity = write_log(options.out, inputs, rows, instances, lambda: load_log_encoder(name, texts, True, options.device), metadata)
    return _finish(options.out, rows, "action-mse", options.preset or "oxe", identity, start)


def _columns(options: argparse.Namespace) -> "Columns":
    from osel_sim.ingestion.columns import COMMAND_LINE
    from osel_sim.ingestion.columns_file import load_columns, parse_columns
    from osel_sim.ingestion.flags import as_data

    files = tuple(options.files or ())
    if options.map is not None:
        _refuse(options, (*TABLE_FLAGS, "policies", "at_least"), "--map: write it into the file")
        return load_columns(options.map, files)
    if not files:
        raise UsageError("--map or --files is missing: give a mapping file, or tables and what their columns mean")
    for flag in ("text", "success"):
        if getattr(options, flag) is None:
            raise UsageError(f"--{flag} is missing; python -m osel_sim.ingest --help shows examples")
    return parse_columns(as_data(options, files), COMMAND_LINE, Path())


def _finish(folder: Path, rows: "list[Row]", metric: str, preset_name: str, encoder: str, start: float) -> int:
    from osel_sim.cli.console import console
    from osel_sim.cli.rollout_tables import print_rollouts
    from osel_sim.selection.reward import preset

    print(f"{folder}: {len(rows)} rows, contexts of {encoder}, {time.perf_counter() - start:.0f} s")
    weights = preset(preset_name)
    if metric == "action-mse":
        weights = replace(weights, success="score")
    print_rollouts(console(), rows, weights)
    print(f"reward ({preset_name}): {weights.success} - {weights.alpha_time} {weights.time_unit} - {weights.alpha_price} cents")
    return 0


if __name__ == "__main__":
    sys.exit(main(None))
