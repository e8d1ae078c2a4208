"""Outcome tables of others as a rollout log."""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from osel_sim.api.results import frame
from osel_sim.api.reward import DEFAULT_PRESET
from osel_sim.api.settings import CONTENT, MAIN, OTHER, Count, Folder, Group, Names, NonNegative, TrustSettings, settings
from osel_sim.core.errors import SettingError, UsageError
from osel_sim.core.trust import trusting
from osel_sim.ingestion.columns import VALUES

if TYPE_CHECKING:
    import pandas

    from osel_sim.formats.rollout_log import Row
    from osel_sim.ingestion.columns import Columns
    from osel_sim.ingestion.convert import Source
    from osel_sim.ingestion.paired import Paired
    from osel_sim.ingestion.records import Record
    from osel_sim.ingestion.write import IngestedInstance
    from osel_sim.interface.encoder import Image
    from osel_sim.selection.reward import RewardWeights

logger = logging.getLogger(__name__)

TABLE_FLAGS = (
    "text",
    "image",
    "group",
    "context",
    "key",
    "policy_column",
    "repeat_column",
    "duplicates",
    "propensity",
    "price_unit",
    "name",
    *VALUES,
)
RESULTS_HAVE = ("text", "image", "group", "context", "key", "policy_column", "repeat_column", "duplicates", "propensity", "policies", "error")
"""Flags that say where a table has what result files have in places of their own."""
COLUMNS = Group("Columns of the tables, instead of --map (a column's name; numbers hold for every row)", 1)
DATASET = Group("A LeRobotDataset, with --metric action-mse", 2)


@settings
class IngestConfig(TrustSettings):
    """Turn outcome tables of others into a rollout log with contexts."""

    out: Annotated[Path | None, MAIN] = None
    """where to write"""
    map: Annotated[Path | None, MAIN] = None
    """mapping file; it alone says what a table's columns mean, or with action-mse which names and conventions of the datasets are others"""
    files: Annotated[Names | None, MAIN] = None
    """tables: .csv, .tsv, .jsonl, .json or .parquet, or folders of such; * stands for anything, {NAME} makes a column of it"""
    results: Annotated[Names | None, MAIN] = None
    """POLICY=FILE for two or more: result files of lerobot-eval (eval_info.json) or vla-eval, whose episodes are paired by task and seed"""
    encoder: Annotated[str | None, MAIN] = None
    """tfidf, sentence:MODEL, MODEL:TAG of open_clip, a folder, or with images also A+tfidf and A+sentence:MODEL; auto for whichever of those at hand
    predicts success best (default: tfidf, and with images osel_small+tfidf)"""
    preset: Annotated[Literal["mmlu", "waymo", "alfred", "oxe"] | None, MAIN] = None
    """weights of the summary's rewards (default: oxe)"""
    device: Annotated[str, OTHER] = "cpu"
    """torch device of the encoder; on another than cpu the last bits may differ"""
    policies_dir: Annotated[Folder | None, CONTENT] = None
    """folder with policy files of your own"""

    name: Annotated[str | None, COLUMNS] = None
    """what the log is called; the task of instances without --group (default: the name of --out)"""
    text: Annotated[str | None, COLUMNS] = None
    """question or instruction: a column, or a template such as '{question} A. {a} B. {b}'"""
    image: Annotated[Names | None, COLUMNS] = None
    """columns with paths of images, relative to the table"""
    group: Annotated[str | None, COLUMNS] = None
    """what the log calls the task, such as a question's subject: a column, or a template"""
    context: Annotated[Names | None, COLUMNS] = None
    """columns that are part of the context besides text and images: numbers, or names of few values; task stands for the group"""
    key: Annotated[str | None, COLUMNS] = None
    """identifies an instance: a column, or a template (default: its text, images and group)"""
    policies: Annotated[Names | None, COLUMNS] = None
    """of a wide table, or those a long one may have; with action-mse those to run"""
    policy_column: Annotated[str | None, COLUMNS] = None
    """says that the table is long, and where it names the policy"""
    repeat_column: Annotated[str | None, COLUMNS] = None
    """numbers repeats of a policy on an instance from 0 on"""
    duplicates: Annotated[Literal["refuse", "drop", "repeats", "keep"] | None, COLUMNS] = None
    """a second row of the same instance (default: refuse)"""
    propensity: Annotated[str | None, COLUMNS] = None
    """with which probability the row's policy was chosen, in a long table whose rows are decisions: logged bandit data"""
    success: Annotated[Names | None, COLUMNS] = None
    """column of true and false, yes and no, 1 and 0; here and below: a column (a.b: b within a), a number, a column in another unit (ms/1000), or
    POLICY=VALUE; {policy} stands for the name"""
    score: Annotated[Names | None, COLUMNS] = None
    """a graded outcome, higher is better"""
    subgoals: Annotated[Names | None, COLUMNS] = None
    """fraction of the subgoals reached"""
    steps: Annotated[Names | None, COLUMNS] = None
    """steps of the robot"""
    seconds: Annotated[Names | None, COLUMNS] = None
    """total, where its parts are not known"""
    upload: Annotated[Names | None, COLUMNS] = None
    """seconds"""
    inference: Annotated[Names | None, COLUMNS] = None
    """seconds"""
    download: Annotated[Names | None, COLUMNS] = None
    """seconds"""
    motion: Annotated[Names | None, COLUMNS] = None
    """seconds"""
    price: Annotated[Names | None, COLUMNS] = None
    """cents, or dollars (--price-unit usd, or a dollar sign in each)"""
    price_unit: Annotated[Literal["cents", "usd"] | None, COLUMNS] = None
    """what prices are given in (default: cents, dollars where they have a dollar sign)"""
    error: Annotated[Names | None, COLUMNS] = None
    """why there is no valid outcome; empty where there is one"""
    at_least: Annotated[float | None, COLUMNS] = None
    """--success is a number of so much or more"""

    metric: Annotated[Literal["table", "action-mse"], DATASET] = "table"
    """read outcomes from a table, or measure them on logged actions"""
    dataset: Annotated[tuple[Folder, ...] | None, DATASET] = None
    """LeRobotDatasets; each one's folder name is a task of the log"""
    camera: Annotated[Names | None, DATASET] = None
    """CAMERA=COLUMN: the dataset's column of a policy's camera (default: observation.images.CAMERA)"""
    frames: Annotated[Count | None, DATASET] = None
    """frames of each episode, evenly spread; each is an instance (default: 4)"""
    tolerance: Annotated[NonNegative | None, DATASET] = None
    """success is a mean squared error of so much or less (default: 0.05)"""


@dataclass(frozen=True)
class IngestResult:
    """What came of an ingestion.

    Attributes:
        folder: of the rollout log.
        rows: of the log.
        encoder: identity of the one whose contexts it has.
        weights: of the summary's rewards, and the preset's name.
        seconds: that it took.
        notes: what was read and what was left out, in words.
    """

    folder: Path
    rows: "list[Row]"
    encoder: str
    weights: "tuple[RewardWeights, str]"
    seconds: float
    notes: tuple[str, ...] = ()

    @cached_property
    def outcomes(self) -> "pandas.DataFrame":
        """A row an outcome."""
        return frame(self.rows)


def ingest(config: IngestConfig | None = None, /, **values: Any) -> IngestResult:
    """Turn outcome tables of others into a rollout log with contexts.

    Args:
        config: settings as one object; `values` change some of them.
        values: settings by name, as `IngestConfig` has them.

    Raises:
        OselError: a table or its mapping is wrong; names file, row and column.
    """
    config = IngestConfig.of(**values) if config is None else config.changed(**values)
    if config.out is None:
        raise SettingError("out", "is missing: give the folder to write to")
    with trusting(config.trust):
        if config.metric == "action-mse":
            _refuse(config, (*TABLE_FLAGS, "files", "results"), "--metric action-mse")
            return _action_mse(config, config.out)
        _refuse(config, ("dataset", "policies_dir", "camera", "frames", "tolerance"), "a table; add --metric action-mse for a LeRobotDataset")
        return _table(config, config.out)


def _refuse(config: IngestConfig, names: Sequence[str], with_what: str) -> None:
    for name in names:
        if getattr(config, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} does not go with {with_what}")


def _table(config: IngestConfig, out: Path) -> IngestResult:
    from osel_sim.analysis.encoder_choice import AUTO, with_best_encoder
    from osel_sim.analysis.log import read_log
    from osel_sim.context.appended import column_parts
    from osel_sim.context.encoder import load_log_encoder
    from osel_sim.context.names import DEFAULT_ENCODER
    from osel_sim.context.text_encoders import TFIDF, text_encoders_at_hand
    from osel_sim.core.files import file_digest
    from osel_sim.formats.rollout_log import PROPENSITIES
    from osel_sim.ingestion.convert import convert
    from osel_sim.ingestion.doubts import alike, beyond_reason
    from osel_sim.ingestion.readers import read_tables
    from osel_sim.ingestion.write import check_out, name_encoder, write_log
    from osel_sim.selection.reward import RewardWeights

    start = time.perf_counter()
    if config.results is not None:
        columns, records, found = _results(config, out)
    else:
        columns, found = _columns(config, out), None
        records = read_tables(columns)
    converted = convert(columns, records)
    instances = [_instance(source) for source in converted.sources]
    inputs = check_out(out, instances)
    keys = [(source.task, source.key.removeprefix(f"{source.task}/")) for source in converted.sources]
    doubts = [*alike("groups", ((task,) for task, _ in keys)), *(alike("instances", keys) if columns.key else ())]
    for doubt in (*(found.doubts if found else ()), *doubts, *beyond_reason(converted.rows, columns.from_flags)):
        logger.warning(doubt)
    notes = [found.note] if found else []
    notes.append(f"{len(records)} rows: {len(instances)} instances, {len(converted.policies)} policies, {len(converted.rows)} outcomes")
    if converted.dropped:
        notes.append(f"{converted.dropped} duplicate rows left out, {converted.differing or 'none'} of which differed from the row that was kept")
    before = f"{DEFAULT_ENCODER}+" if columns.images else ""
    names = [before + text for text in text_encoders_at_hand()] if config.encoder == AUTO else [config.encoder or before + TFIDF]
    sources = dict(found.files) if found else {file.name: file for file in {record.file for record in records}}
    metadata: dict[str, Any] = {
        "task": columns.name,
        "policies": converted.policies,
        "source": {"metric": "table", "files": {name: file_digest(sources[name]) for name in sorted(sources)}},
    }
    if converted.propensities is not None:
        metadata[PROPENSITIES] = converted.propensities
    texts = [item.text for item in instances]
    values = {column: [source.context[at] for source in converted.sources] for at, column in enumerate(columns.context)}
    appended = column_parts(values) if values else None
    loads = [partial(load_log_encoder, name, texts, bool(columns.images), config.device) for name in names]
    identities = [write_log(out, inputs, converted.rows, instances, load, metadata, appended) for load in loads]
    identity = identities[0]
    if config.encoder == AUTO:
        _, choice = with_best_encoder(read_log(out, identity), RewardWeights(0.0, 0.0))
        identity = choice.encoder
        name_encoder(out, identity)
        notes.append(str(choice))
    return _result(config, out, converted.rows, identity, start, tuple(notes))


def _instance(source: "Source") -> "IngestedInstance":
    """What is to be encoded of an instance, with its images looked at: a broken one is found before an hour of encoding, not after."""
    from osel_sim.core.files import file_digest
    from osel_sim.core.images import load_image
    from osel_sim.ingestion.write import IngestedInstance

    def images() -> "list[Image]":
        return [load_image(image, source.record.where) for image in source.images]

    images()
    return IngestedInstance(source.key, source.text, " ".join(file_digest(image) for image in source.images), images)


def _action_mse(config: IngestConfig, out: Path) -> IngestResult:
    from osel_sim.analysis.encoder_choice import AUTO
    from osel_sim.context.encoder import load_log_encoder
    from osel_sim.context.names import DEFAULT_ENCODER
    from osel_sim.context.text_encoders import TFIDF
    from osel_sim.episodes.drivers import choose_policies
    from osel_sim.formats.dataset_mapping import load_dataset_mapping
    from osel_sim.ingestion.action_mse import Measurement, measure_errors, open_datasets
    from osel_sim.ingestion.write import check_out, write_log
    from osel_sim.interface.specification import specification

    start = time.perf_counter()
    if config.encoder == AUTO:
        raise UsageError(f"--encoder {AUTO} is for tables: name the encoder of a dataset's frames")
    if not config.dataset:
        raise SettingError("dataset", "is missing: give the folder of a LeRobotDataset")
    specs = choose_policies(config.policies, specification(), config.policies_dir)
    cameras = {}
    for item in config.camera or ():
        camera, equals, column = item.partition("=")
        if not (camera and equals and column):
            raise SettingError("camera", f"must be CAMERA=COLUMN, got {item!r}")
        cameras[camera] = column
    mapping = load_dataset_mapping(config.map)
    measured = Measurement(config.frames or 4, 0.05 if config.tolerance is None else config.tolerance, cameras, mapping, config.map)
    samples = open_datasets(config.dataset, specs, measured)
    instances = [sample.instance for sample in samples]
    inputs = check_out(out, instances)
    name, texts = config.encoder or f"{DEFAULT_ENCODER}+{TFIDF}", [item.text for item in instances]
    encoder = load_log_encoder(name, texts, True, config.device)  # one that cannot be loaded is found before the policies are asked, not after
    rows, source = measure_errors(samples, specs, measured)
    # By `metric`, replay and report know that what counts is the score.
    metadata = {"task": "action-mse", "policies": [spec.name for spec in specs], "source": {"metric": "action-mse", **source}}
    identity = write_log(out, inputs, rows, instances, lambda: encoder, metadata)
    return _result(config, out, rows, identity, start)


def _columns(config: IngestConfig, out: Path) -> "Columns":
    from osel_sim.ingestion.columns import COMMAND_LINE
    from osel_sim.ingestion.columns_file import load_columns, parse_columns
    from osel_sim.ingestion.flags import as_data, scaled
    from osel_sim.ingestion.readers import first_columns

    files = config.files or ()
    if config.map is not None:
        _refuse(config, (*TABLE_FLAGS, "policies", "at_least"), "--map: write it into the file")
        return load_columns(config.map, files)
    if not files:
        raise UsageError("--map or --files is missing: give a mapping file, or tables and what their columns mean")
    for name in ("text", "success"):
        if getattr(config, name) is None:
            raise SettingError(name, "is missing; python -m osel_sim.ingest --help shows examples")
    return parse_columns(as_data(config, files, first_columns(Path(), files) if scaled(config) else ()), COMMAND_LINE, Path())


def _results(config: IngestConfig, out: Path) -> "tuple[Columns, list[Record], Paired]":
    """Result files as a long table: what its columns mean, its rows, and how they were paired."""
    from osel_sim.core.errors import DataError, did_you_mean
    from osel_sim.ingestion.columns import COMMAND_LINE, flag
    from osel_sim.ingestion.columns_file import parse_columns
    from osel_sim.ingestion.flags import as_data
    from osel_sim.ingestion.paired import COLUMNS, read_results
    from osel_sim.ingestion.records import listed

    _refuse(config, ("map", "files", *RESULTS_HAVE), "--results, which says it itself")
    found = read_results(config.results or ())
    there = [*found.measured, *COLUMNS]
    told = {"text": "instruction", "group": "task", "key": "episode", "policy_column": "policy", "policies": tuple(found.files), "error": ("error",)}
    if config.success is None:
        told["success"] = ("success",)
    if config.steps is None and "steps" in found.measured:
        told["steps"] = ("steps",)
    columns = parse_columns(as_data(config.changed(**told), tuple(map(str, found.files.values())), there), COMMAND_LINE, Path())
    for column, key in columns.needed.items():
        if column not in there:
            measured = f"{did_you_mean(column, found.measured)}measured in all of them: {listed(sorted(found.measured)) or 'nothing else'}"
            raise DataError(f"{', '.join(map(str, found.files.values()))}: there is no {column!r}, which {flag(key)} names: {measured}")
    return columns, found.records, found


def _result(config: IngestConfig, out: Path, rows: "list[Row]", encoder: str, start: float, notes: tuple[str, ...] = ()) -> IngestResult:
    from osel_sim.selection.reward import preset

    name = config.preset or DEFAULT_PRESET
    weights = preset(name)
    if config.metric == "action-mse":
        weights = replace(weights, success="score")
    return IngestResult(out, rows, encoder, (weights, name), time.perf_counter() - start, notes)
