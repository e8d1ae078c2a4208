"""The rollout log: outcomes of every policy on the same instances, with repeats: `rollouts.parquet`.

The contexts lie beside it in `contexts.npz` (osel_sim.context.cache). The file is a function of its content alone: no time stamps, rows in the order
instance, policy, repeat. Logs from elsewhere (osel_sim.ingest) fit the same columns; those that make no sense there are null.

Version 2 of the schema has two columns more. `score`: what was measured where success is a matter of degree, such as minus an action MSE; it is null
in what this suite records. `axes`: those perturbed beyond `level`, such as `camera=2`. Version 3 has `robot`, and is written only where one is
not the usual Panda. Logs of earlier versions are read as before, with what they lack null.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim.core.arrays import check_rows
from osel_sim.core.errors import DataError
from osel_sim.core.files import atomic
from osel_sim.interface.outcome import Outcome, Seconds

if TYPE_CHECKING:
    import pyarrow

SCHEMA_VERSION = 3
_COLUMNS_ADDED = {2: ("score", "axes"), 3: ("robot",)}
"""Columns that came with a version; logs of an earlier one are read without them."""
ROLLOUTS = "rollouts.parquet"
PROPENSITIES = "propensities"
"""Key in a log's metadata: with which probability the policy of each row was chosen, where the log is of decisions (logged bandit data)."""
DECLARED = "skills"
"""Key of the metadata that says what policies declare: policy -> names of skills. Examples of them lie among the contexts."""
_PREFIX = b"osel_sim."


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

    @property
    def outcome(self) -> Outcome:
        """What came of an episode in simulation, without what it was about.

        Raises:
            DataError: a row from elsewhere that lacks something an episode has.
        """
        missing = [name for name in _EPISODE if getattr(self, name) is None]
        if missing:
            raise DataError(f"instance {self.instance!r}, policy {self.policy!r} is no episode in simulation: it has no {', '.join(missing)}")
        own = {field.name: getattr(self, field.name) for field in fields(Outcome) if field.name != "seconds"}
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
    # A log of the usual robot alone stays one that earlier versions of osel_sim read.
    version = SCHEMA_VERSION if any(row.robot is not None for row in rows) else 2
    extra = {**metadata, "schema_version": version}
    annotated = schema(version).with_metadata(
        {_PREFIX + key.encode(): json.dumps(value, sort_keys=True).encode() for key, value in sorted(extra.items())}
    )
    table = pyarrow.Table.from_pylist([vars(row) for row in rows], schema=annotated)
    file = folder / ROLLOUTS
    with atomic(file) as partial:
        pyarrow.parquet.write_table(table, partial, compression="zstd")
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
        found = pyarrow.parquet.read_schema(file)
        check_rows(file)
    except (pyarrow.ArrowException, OSError) as error:
        raise DataError(f"{file} is not a Parquet file ({error})") from None
    raw = found.metadata or {}
    try:
        metadata = {key.removeprefix(_PREFIX).decode(): json.loads(value) for key, value in raw.items() if key.startswith(_PREFIX)}
    except ValueError as error:
        raise DataError(f"{file}: its metadata cannot be read ({error})") from None
    version = metadata.get("schema_version")
    if not isinstance(version, int) or not 1 <= version <= SCHEMA_VERSION:
        raise DataError(f"{file}: osel_sim.schema_version must be 1 to {SCHEMA_VERSION}, got {version}")
    columns = schema(version).names
    if found.names != columns:
        raise DataError(f"{file}: columns must be {', '.join(columns)}; got {', '.join(found.names)}")
    _check_types(file, found)
    try:
        table = pyarrow.parquet.read_table(file)
        table.validate(full=True)  # text is UTF-8
    except (pyarrow.ArrowException, OSError) as error:
        raise DataError(f"{file} is not a whole Parquet file ({' '.join(str(error).split())})") from None
    return [Row(**row) for row in _checked(file, table).to_pylist()], metadata


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
    refuse("repeat", pyarrow.compute.less(table["repeat"], 0), "must be 0 or more")
    success = pyarrow.compute.fill_null(table["success"].cast(pyarrow.bool_()), False)
    return table.set_column(table.schema.get_field_index("success"), "success", success)


def _type_name(kind: object) -> str:
    return kind.__name__ if isinstance(kind, type) else str(kind)
