"""The rollout log: outcomes of every policy on the same instances, with repeats: `rollouts.parquet`.

The contexts lie beside it in `contexts.npz` (osel_sim.context.cache). The file is a function of its content alone: no time stamps, rows in the order
instance, policy, repeat. Logs from elsewhere (osel_sim.ingest) fit the same columns; those that make no sense there are null.

Version 2 of the schema has two columns more. `score`: what was measured where success is a matter of degree, such as minus an action MSE; it is null
in what this suite records. `axes`: those perturbed beyond `level`, such as `camera=2`. Version 3 has `robot`, and is written only where one is
not the usual Panda; version 4 `fallback_steps`, only where a fallback took over; version 5 `scene`, where the suite tells it. Logs of earlier
versions are read as before, with what they lack null.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim.core.arrays import check_rows
from osel_sim.core.errors import DataError
from osel_sim.core.files import atomic, content_digest
from osel_sim.formats.toml_types import plain_name, quoted
from osel_sim.formats.values import NAME, ROW, TEXTS
from osel_sim.interface.instance import instance_key, label
from osel_sim.interface.outcome import Outcome, Seconds

if TYPE_CHECKING:
    import pyarrow

SCHEMA_VERSION = 5
_COLUMNS_ADDED = {2: ("score", "axes"), 3: ("robot",), 4: ("fallback_steps",), 5: ("scene",)}
"""Columns that came with a version; logs of an earlier one are read without them."""
ROLLOUTS = "rollouts.parquet"
PROPENSITIES = "propensities"
"""Key in a log's metadata: with which probability the policy of each row was chosen, where the log is of decisions (logged bandit data)."""
DECLARED = "skills"
"""Key of the metadata that says what policies declare: policy -> names of skills. Examples of them lie among the contexts."""
_PREFIX, _CHECKSUM = b"osel_sim.", "checksum"
_ABOUT = ("task", "seed", "level", "split", "axes", "robot", "instruction", "phrasing", "target", "container")
"""Columns that are the same in all rows of an instance."""
_about = attrgetter(*_ABOUT)


@dataclass(frozen=True)
class Row:
    """One episode: what it was about, who drove, what came of it.

    Attributes:
        instance: key of the instance, the same for all its rows; `contexts.npz` has it too.
        phrasing: which wording of the task's language the instruction uses.
        axes: the axes perturbed beyond `level`, as `camera=2,light=1`; None where there are none.
        target, container: the object asked for and where it goes.
        upload ... motion: seconds, as in `Outcome`.
        score: a graded outcome, higher is better, where there is one; None otherwise. `success` is there all the same, such as "score >= 0.5".
        robot: the robot's name, None for the usual one.
        scene: digest of how the scene was set up, with the instruction; None where nobody told, or the worker died before.
        Others: as in `Outcome`.

    Logs from elsewhere have None where a column makes no sense: no robot, no steps; no price known, no price. Never a made-up number.
    """

    task: str
    instance: str
    seed: int | None
    level: int | None
    split: str | None
    instruction: str | None
    phrasing: str | None
    target: str | None
    container: str | None
    policy: str
    repeat: int
    success: bool
    subgoals: float | None
    steps: int | None
    upload: float | None
    inference: float | None
    download: float | None
    motion: float | None
    calls: int | None
    actions: int | None
    price: float | None
    fallback: str | None
    error: str | None
    score: float | None = None
    axes: str | None = None
    robot: str | None = None
    fallback_steps: int | None = None
    scene: str | None = None

    @property
    def outcome(self) -> Outcome:
        """What came of an episode in simulation, without what it was about.

        Raises:
            DataError: a row from elsewhere that lacks something an episode has.
        """
        missing = [name for name in _EPISODE if getattr(self, name) is None]
        if missing:
            raise DataError(f"instance {self.instance!r}, policy {self.policy!r} is no episode in simulation: it has no {', '.join(missing)}")
        own = {field.name: getattr(self, field.name) for field in fields(Outcome) if field.name not in ("seconds", "monitored")}
        return Outcome(seconds=Seconds(*(getattr(self, field.name) for field in fields(Seconds))), **own)


_EPISODE = ("subgoals", "steps", "upload", "inference", "download", "motion", "calls", "actions", "price")


def schema(version: int = SCHEMA_VERSION) -> "pyarrow.Schema":
    """Columns of `rollouts.parquet` with their types; all but task, instance, policy, repeat and success may be null."""
    import pyarrow

    kinds = {"str": pyarrow.string(), "int": pyarrow.int64(), "float": pyarrow.float64(), "bool": pyarrow.bool_()}
    needed = ("task", "instance", "policy", "repeat", "success")
    later = {name for since, names in _COLUMNS_ADDED.items() if since > version for name in names}
    types = {field.name: kinds[_type_name(field.type).removesuffix(" | None")] for field in fields(Row) if field.name not in later}
    return pyarrow.schema([pyarrow.field(name, kind, nullable=name not in needed) for name, kind in types.items()])


def write_rollouts(folder: Path, rows: Iterable[Row], metadata: dict[str, Any]) -> Path:
    """Write `rollouts.parquet`, at once or not at all.

    Args:
        metadata: goes into the file's metadata as JSON, under `osel_sim.<key>`, beside the schema version.
    """
    import pyarrow
    import pyarrow.parquet

    rows = list(rows)
    # A log of the usual robot alone, without fallbacks, stays one that earlier versions of osel_sim read.
    needed = (since for since, names in _COLUMNS_ADDED.items() if any(getattr(row, name) is not None for row in rows for name in names))
    version = max([2, *needed])
    extra = {**metadata, "schema_version": version, _CHECKSUM: _checksum(metadata)}
    annotated = schema(version).with_metadata(
        {_PREFIX + key.encode(): json.dumps(value, sort_keys=True).encode() for key, value in sorted(extra.items())}
    )
    table = pyarrow.Table.from_pylist([vars(row) for row in rows], schema=annotated)
    file = folder / ROLLOUTS
    with atomic(file) as partial:
        pyarrow.parquet.write_table(table, partial.absolute(), compression="zstd", write_page_checksum=True)
    return file


def read_rollouts(folder: Path) -> tuple[list[Row], dict[str, Any]]:
    """Rows and metadata of a rollout log.

    Raises:
        DataError: no log there, or one of another form; names the column that is wrong.
    """
    import pyarrow
    import pyarrow.parquet

    file = folder / ROLLOUTS
    if not file.is_file():
        raise DataError(
            f"{file} does not exist; python -m osel_sim.record or, from a table, python -m osel_sim.ingest with --out {folder} writes it; "
            "the same command goes on with an interrupted one"
        )
    try:
        found = pyarrow.parquet.read_schema(file.absolute())
        check_rows(file)
        names = list(found.names)
    except DataError:
        raise
    except Exception as error:  # of damaged bytes pyarrow says different things, UnicodeDecodeError among them
        raise DataError(f"{file} is not a Parquet file ({_in_one_line(error)})") from None
    metadata = _metadata(file, found.metadata or {})
    columns = schema(metadata["schema_version"]).names
    if names != columns:
        raise DataError(f"{file}: columns must be {', '.join(columns)}; got {', '.join(map(plain_name, names))}")
    _check_types(file, found)
    try:
        # Logs of earlier versions have no checksums; types and ranges are all that tells damage there.
        table = pyarrow.parquet.read_table(file.absolute(), page_checksum_verification=True)
        table.validate(full=True)  # text is UTF-8
        if (claimed := pyarrow.parquet.read_metadata(file.absolute()).num_rows) != table.num_rows:
            raise DataError(f"{file}: claims {claimed} rows, has {table.num_rows}")
        values = _checked(file, table).to_pylist()
    except DataError:
        raise
    except Exception as error:
        raise DataError(f"{file} is not a whole Parquet file ({_in_one_line(error)})") from None
    _check_values(file, values)
    rows = [Row(**row) for row in values]
    _check_together(file, rows)
    return rows, metadata


def row_fault(row: Row) -> str | None:
    """What does not fit together in a row whose fields are right one by one; None where all does."""
    if row.seed is None or row.level is None or row.split is None:
        return None  # from elsewhere
    key = instance_key(row.task, row.split, label(row.level, row.axes), row.seed, row.robot)
    return None if row.instance == key else f"instance must be {key!r}, which its task, split, level, axes, seed and robot make, got {row.instance!r}"


def _metadata(file: Path, raw: dict[bytes, bytes]) -> dict[str, Any]:
    try:
        metadata = {key.removeprefix(_PREFIX).decode(): json.loads(value) for key, value in raw.items() if key.startswith(_PREFIX)}
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file}: its metadata cannot be read ({error})") from None
    version = metadata.get("schema_version")
    if not isinstance(version, int) or isinstance(version, bool) or not 1 <= version <= SCHEMA_VERSION:
        raise DataError(f"{file}: osel_sim.schema_version must be 1 to {SCHEMA_VERSION}, got {version}")
    written = metadata.pop(_CHECKSUM, None)  # logs of earlier versions have none
    if written is not None and written != _checksum(metadata):
        raise DataError(f"{file}: its metadata is damaged: it does not fit its checksum")
    policies, encoder = metadata.get("policies", []), metadata.get("encoder")
    if not isinstance(policies, list) or not all(map(NAME.fits, policies)):
        raise DataError(f"{file}: policies in its metadata must be a list of names, got {quoted(policies)}")
    if not TEXTS.fits(metadata.get("content") or {}):
        raise DataError(f"{file}: content in its metadata must be {TEXTS.wanted}, got {quoted(metadata['content'])}")
    if not NAME.or_null.fits(encoder):
        raise DataError(f"{file}: encoder in its metadata must be {NAME.or_null.wanted}, got {quoted(encoder)}")
    return metadata


def _check_values(file: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    for name, kind in ROW.items():
        column = [row.get(name) for row in rows]
        if not all(map(kind.fits, set(column))):  # columns repeat few values over and over
            number, value = next((number, value) for number, value in enumerate(column, 1) if not kind.fits(value))
            raise DataError(f"{file}: column {name!r}, row {number}: must be {kind.wanted}, got {quoted(value)}")


def _check_together(file: Path, rows: Sequence[Row]) -> None:
    """Refuse an episode that is there twice, and rows of one instance that say different things of it."""
    seen, first, scenes = set[tuple[str, str, int]](), dict[str, Row](), dict[str, str]()
    for number, row in enumerate(rows, 1):
        if (episode := (row.instance, row.policy, row.repeat)) in seen:
            raise DataError(f"{file}: row {number}: instance {row.instance!r}, policy {row.policy!r}, repeat {row.repeat} is there twice")
        seen.add(episode)
        if row.scene is not None and row.scene != (was := scenes.setdefault(row.instance, row.scene)):
            raise DataError(f"{file}: row {number}: instance {row.instance!r}: its scene is {row.scene!r}, in an earlier row it is {was!r}")
        if row.instance not in first:
            first[row.instance] = row
            if problem := row_fault(row):
                raise DataError(f"{file}: row {number}: {problem}")
        elif _about(row) != _about(first[row.instance]):
            name, was, now = next(item for item in zip(_ABOUT, _about(first[row.instance]), _about(row), strict=True) if item[1] != item[2])
            raise DataError(f"{file}: row {number}: instance {row.instance!r}: its {name} is {quoted(now)}, in an earlier row it is {quoted(was)}")


def _in_one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__


def _checksum(metadata: Mapping[str, Any]) -> str:
    """Of the metadata: the checksums of a Parquet file's pages are of its columns only."""
    return content_digest(json.dumps({key: value for key, value in metadata.items() if key not in ("schema_version", _CHECKSUM)}, sort_keys=True))


def _check_types(file: Path, found: "pyarrow.Schema") -> None:
    """Refuse columns of another kind. How wide a number is, or how text is encoded, does not matter: others write logs too."""
    import pyarrow

    types = pyarrow.types
    for field, expected in zip(found, map(schema().field, found.names), strict=True):
        kind = field.type
        words = kind.value_type if types.is_dictionary(kind) else kind
        fits, content = {
            pyarrow.string(): (types.is_string(words) or types.is_large_string(words), "text"),
            pyarrow.int64(): (types.is_integer(kind), "integers"),
            pyarrow.float64(): (types.is_floating(kind) or types.is_integer(kind), "numbers"),
            pyarrow.bool_(): (types.is_boolean(kind), "true and false"),
        }[expected.type]
        if not fits and not types.is_null(kind):  # null: the column is empty
            raise DataError(f"{file}: column {field.name!r} must hold {content}, its type is {kind}")


def _checked(file: Path, table: "pyarrow.Table") -> "pyarrow.Table":
    """The table, if every row has what it needs. No success beside an error is false: there was no valid outcome."""
    import pyarrow.compute

    def refuse(column: str, wrong: Any, problem: str) -> None:
        row = pyarrow.compute.index(wrong, True).as_py()
        if row >= 0:
            raise DataError(f"{file}: column {column!r}, row {row + 1}: {problem}")

    for name in ("task", "instance", "policy", "repeat"):
        refuse(name, table[name].is_null(), "is empty, every row needs one")
    missing = table["success"].is_null()
    refuse("success", pyarrow.compute.and_(missing, table["error"].is_null()), "is empty, and error does not say why")
    success = pyarrow.compute.fill_null(table["success"].cast(pyarrow.bool_()), False)
    return table.set_column(table.schema.get_field_index("success"), "success", success)


def _type_name(kind: object) -> str:
    return kind.__name__ if isinstance(kind, type) else str(kind)
