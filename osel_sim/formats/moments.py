"""The table of moments: what became of an episode had another policy taken over at one of its decision points: `moments.parquet`.

It lies in the folder of a rollout log, which has the episodes themselves. Each was cut before every K-th call, and from that state every other policy
drove on to the end. What was to be seen at each moment lies beside it, in `moments.npz`: the encoder's pictures and the signals that a monitor is
shown.

Both are functions of their content alone: no time stamps, rows in the order instance, first policy, repeat, call, second policy (none first). The
table's metadata holds the digest of `moments.npz`, so that two that do not belong together are told.
"""

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.arrays import check_rows, read_arrays
from osel_sim.core.errors import DataError
from osel_sim.core.files import atomic, content_digest, write_bytes
from osel_sim.core.parquet import PARQUET_ERRORS, open_parquet, unreadable
from osel_sim.formats.toml_types import quoted
from osel_sim.formats.values import AMOUNT, COUNT, FLAG, NAME, SHARE, TEXT, Kind
from osel_sim.interface.outcome import Outcome, Seconds

if TYPE_CHECKING:
    import pyarrow

SCHEMA_VERSION = 1
MOMENTS, SEEN = "moments.parquet", "moments.npz"
SIGNALS = ("seconds", "price", "time_used", "overlap", "moved", "change")
"""What is kept of each moment besides the picture, as `osel_sim.interface.monitor.DecisionPoint` names it; NaN where it has none."""
_PREFIX = "osel_sim."


@dataclass(frozen=True)
class MomentRow:
    """One way an episode went on from one of its moments.

    Attributes:
        instance: key of the instance, as in the rollout log.
        first: the policy that drove up to the moment.
        repeat: of its episode.
        call, step: calls of it, and control steps, before the moment; at least 1 each.
        second: the policy that drove from then on; None: the first went on, and the row says what the rollout log does.
        price_first: cents of the first policy.
        remote_steps: of `steps` those that a remote policy drove.
        Others: as in `osel_sim.interface.outcome.Outcome`, of the whole episode.
    """

    instance: str
    first: str
    repeat: int
    call: int
    step: int
    second: str | None
    success: bool
    subgoals: float
    steps: int
    upload: float
    inference: float
    download: float
    motion: float
    calls: int
    actions: int
    price: float
    price_first: float
    remote_steps: int
    fallback: str | None = None
    error: str | None = None
    fallback_steps: int | None = None

    @property
    def moment(self) -> tuple[str, str, int, int]:
        """Which moment it goes on from: instance, first policy, repeat, call."""
        return self.instance, self.first, self.repeat, self.call

    @property
    def outcome(self) -> Outcome:
        """What came of the whole episode."""
        own = {field.name: getattr(self, field.name) for field in fields(Outcome) if field.name in _NAMES}
        return Outcome(seconds=Seconds(*(getattr(self, field.name) for field in fields(Seconds))), **own)


_NAMES = tuple(field.name for field in fields(MomentRow))
_KINDS: Mapping[str, Kind] = {
    **{"instance": NAME, "first": NAME, "repeat": COUNT, "call": COUNT, "step": COUNT, "second": NAME.or_null},
    **{"success": FLAG, "subgoals": SHARE, "steps": COUNT, "calls": COUNT, "actions": COUNT, "remote_steps": COUNT},
    **{name: AMOUNT for name in ("upload", "inference", "download", "motion", "price", "price_first")},
    **{"fallback": TEXT.or_null, "error": TEXT.or_null, "fallback_steps": COUNT.or_null},
}


@dataclass(frozen=True)
class Seen:
    """What was to be seen at M moments, in the order in which they first appear in the table.

    Attributes:
        pictures: float32 (M, D), as `osel_sim.interface.monitor.Look.picture` gives it.
        signals: float64 (M, len(SIGNALS)).
    """

    pictures: NDArray[np.float32]
    signals: NDArray[np.float64]


@dataclass(frozen=True)
class MomentTable:
    """A table that was read.

    Attributes:
        rows: of all moments.
        seen: of each moment.
        metadata: every (the K of `record --moments`), most (moments of an episode at most), policies, remote (which of them are) and encoder.
    """

    rows: Sequence[MomentRow]
    seen: Seen
    metadata: Mapping[str, Any]


def schema() -> "pyarrow.Schema":
    """Columns of `moments.parquet` with their types."""
    import pyarrow

    kinds = {"str": pyarrow.string(), "int": pyarrow.int32(), "float": pyarrow.float64(), "bool": pyarrow.bool_()}
    types = {field.name: str(getattr(field.type, "__name__", field.type)) for field in fields(MomentRow)}
    return pyarrow.schema([pyarrow.field(name, kinds[kind.partition(" ")[0]], nullable="None" in kind) for name, kind in types.items()])


def write_moments(folder: Path, rows: Iterable[MomentRow], seen: Seen, metadata: Mapping[str, Any]) -> None:
    """Write both files, each at once or not at all; the table last.

    Args:
        seen: of each moment, in the order of rows.
        metadata: as `MomentTable` has it.
    """
    import pyarrow
    import pyarrow.parquet

    content = _npz(seen)
    said = {**metadata, "schema_version": SCHEMA_VERSION, "seen_sha256": content_digest(content)}
    text = json.dumps(said, sort_keys=True)
    annotated = schema().with_metadata({f"{_PREFIX}moments": text, f"{_PREFIX}checksum": content_digest(text)})
    table = pyarrow.Table.from_pylist([vars(row) for row in rows], schema=annotated)
    write_bytes(folder / SEEN, content)
    with atomic(folder / MOMENTS) as partial:
        pyarrow.parquet.write_table(table, partial.absolute(), compression="zstd", write_page_checksum=True)


def read_moments(folder: Path) -> MomentTable:
    """Read both files.

    Raises:
        DataError: missing, damaged, of another form, or two files that do not belong together; names the column and the row that are wrong.
    """
    file = folder / MOMENTS
    if not file.is_file():
        raise DataError(f"{file} does not exist; python -m osel_sim.record --moments K --out {folder} writes it")
    try:
        opened = open_parquet(file)
        check_rows(file)
        found = opened.schema_arrow
        metadata = _metadata(file, found.metadata or {})
        if not found.equals(schema()):
            wanted = ", ".join(f"{field.name} ({field.type})" for field in schema())
            raise DataError(f"{file}: columns must be {wanted}; got {', '.join(f'{field.name} ({field.type})' for field in found)}")
        values = opened.read().to_pylist()
    except PARQUET_ERRORS as error:
        raise unreadable(file, error) from None
    rows = [_row(value, f"{file}, row {number}") for number, value in enumerate(values, 1)]
    _check_together(file, rows, metadata)
    return MomentTable(rows, _seen(folder / SEEN, metadata, len({row.moment for row in rows})), metadata)


def moment_row(value: Mapping[str, Any], place: str) -> MomentRow:
    """One row from plain data, such as a line of a recording that goes on.

    Raises:
        DataError: naming the place and the field.
    """
    if set(value) != set(_NAMES):
        raise DataError(f"{place}: a moment's fields must be {', '.join(_NAMES)}, got {quoted(sorted(value))}")
    return _row(value, place)


def _row(value: Mapping[str, Any], place: str) -> MomentRow:
    for name, kind in _KINDS.items():
        if not kind.fits(value[name]):
            raise DataError(f"{place}: {name} must be {kind.wanted}, got {quoted(value[name])}")
    row = MomentRow(**value)
    if problem := _fault(row):
        raise DataError(f"{place}: {problem}")
    return row


def _fault(row: MomentRow) -> str | None:
    """What does not fit together in a row; None where all does."""
    if min(row.call, row.step) < 1:
        return f"call and step must be 1 or more: at the beginning nobody has driven; got {row.call} and {row.step}"
    if row.second == row.first:
        return f"second must be another policy than first, or null, got {row.second!r}"
    if row.error is None and row.steps <= row.step:
        return f"steps must be more than the {row.step} before the moment, got {row.steps}"
    if row.remote_steps > row.steps or row.price_first > row.price + 1e-9:
        return f"remote_steps ({row.remote_steps}) and price_first ({row.price_first}) must be parts of steps ({row.steps}) and price ({row.price})"
    return None


def _check_together(file: Path, rows: Sequence[MomentRow], metadata: Mapping[str, Any]) -> None:
    """Refuse a way on that is there twice, a moment without all of its ways on, and one that is no multiple of K."""
    policies, every = metadata["policies"], metadata["every"]
    ways = dict[tuple[str, str, int, int], list[str | None]]()
    steps = dict[tuple[str, str, int, int], int]()
    for number, row in enumerate(rows, 1):
        place = f"{file}, row {number}"
        if row.first not in policies or row.second not in (None, *policies):
            raise DataError(f"{place}: first and second must be of {', '.join(policies)}, got {quoted(row.first)} and {quoted(row.second)}")
        if row.call % every:
            raise DataError(f"{place}: call must be a multiple of {every}, got {row.call}")
        if row.step != steps.setdefault(row.moment, row.step):
            raise DataError(f"{place}: step is {row.step}, in an earlier row of the same moment {steps[row.moment]}")
        if row.second in ways.setdefault(row.moment, []):
            raise DataError(f"{place}: {row.instance!r}, {row.first!r}, repeat {row.repeat}, call {row.call} goes on with {row.second!r} twice")
        ways[row.moment].append(row.second)
    for moment, there in ways.items():
        if missing := {None, *policies} - {moment[1], *there}:
            raise DataError(
                f"{file}: {moment[0]!r}, {moment[1]!r}, repeat {moment[2]}, call {moment[3]} does not go on with {quoted(min(missing, key=str))}"
            )


def _metadata(file: Path, raw: Mapping[bytes, bytes]) -> dict[str, Any]:
    text = raw.get(f"{_PREFIX}moments".encode(), b"")
    if raw.get(f"{_PREFIX}checksum".encode(), b"").decode("ascii", "replace") != content_digest(text):
        raise DataError(f"{file}: its metadata is damaged, or it is no table of moments")
    said = json.loads(text)
    if said.get("schema_version") != SCHEMA_VERSION:
        raise DataError(f"{file}: schema_version must be {SCHEMA_VERSION}, got {quoted(said.get('schema_version'))}")
    return dict(said)


def _npz(seen: Seen) -> bytes:
    buffer = io.BytesIO()
    arrays: dict[str, NDArray[Any]] = {"pictures": seen.pictures.astype(np.float32), "signals": seen.signals.astype(np.float64)}
    np.savez_compressed(buffer, allow_pickle=False, names=np.array(SIGNALS, np.str_), **arrays)
    return buffer.getvalue()


def _seen(file: Path, metadata: Mapping[str, Any], moments: int) -> Seen:
    try:
        content = file.read_bytes()
    except OSError as error:
        raise DataError(f"{file}: cannot be read ({error.strerror})") from None
    if content_digest(content) != metadata.get("seen_sha256"):
        raise DataError(f"{file} is damaged, or does not belong to the {MOMENTS} beside it")
    arrays = read_arrays(file, "what was seen at moments", content)
    pictures, signals, names = (arrays.get(name, np.zeros(0)) for name in ("pictures", "signals", "names"))
    if names.tolist() != list(SIGNALS) or pictures.dtype != np.float32 or signals.dtype != np.float64:
        raise DataError(f"{file}: must hold pictures (float32) and signals (float64) named {', '.join(SIGNALS)}")
    if pictures.ndim != 2 or len(pictures) != moments or signals.shape != (moments, len(SIGNALS)) or not np.isfinite(pictures).all():
        raise DataError(
            f"{file}: the {moments} moments of the table need as many finite pictures and signals, got {pictures.shape} and {signals.shape}"
        )
    return Seen(pictures, signals)
