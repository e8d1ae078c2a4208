"""`encoders.jsonl`: which encoder a live run with `--encoder auto` goes on with, one look at the evidence a line.

A line is on disk before the decision that it comes before, and has its own checksum; the file is written whole or not at all. `run.json` names the
encoder of the last line as the run's: it has contexts of all its instances.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osel_sim.core.errors import DataError
from osel_sim.core.files import content_digest, write_bytes, write_json
from osel_sim.formats.encoder_choice import EncoderChoice
from osel_sim.formats.journal import read_lines, to_line
from osel_sim.formats.run_config import RUN, read_run
from osel_sim.formats.values import AMOUNT, COUNT, FLAG, NAME, NUMBER, Kind, fault

CHECKS = "encoders.jsonl"


def _is_gain(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and NUMBER.fits(value[0]) and AMOUNT.fits(value[1])


_GAINS = Kind("a gain and its error, two numbers, by encoder", lambda value: isinstance(value, dict) and all(map(_is_gain, value.values())))
_KINDS = {"before": COUNT, "encoder": NAME, "decisions": COUNT, "gains": _GAINS, "final": FLAG, "checksum": NAME}


@dataclass(frozen=True)
class EncoderCheck:
    """One look at the evidence.

    Attributes:
        before: index of the first decision after it.
        choice: the encoder that the run goes on with, on the decisions that had a reward.
        final: the run goes on with it to the end.
    """

    before: int
    choice: EncoderChoice
    final: bool

    @property
    def words(self) -> str:
        """In words, as a sentence without its full stop."""
        later = "" if self.final else "; it is asked again later"
        return f"from decision {self.before} on {self.choice.words('decisions')}{later}"

    def to_dict(self) -> dict[str, Any]:
        """As the file has it, without the checksum."""
        choice = self.choice
        gains = {name: [float(gain), float(error)] for name, (gain, error) in choice.gains.items()}
        return {"before": self.before, "encoder": choice.encoder, "decisions": choice.instances, "gains": gains, "final": self.final}


def read_checks(folder: Path) -> tuple[EncoderCheck, ...]:
    """The lines of a live run's folder in their order; none where the file is not there.

    Raises:
        DataError: naming file and line: damaged, out of order, or one that cannot be.
    """
    file = folder / CHECKS
    found: list[EncoderCheck] = []
    for number, (data, raw) in enumerate(read_lines(file), 1):
        place = f"{file}, line {number}"
        if problem := fault(data, _KINDS):
            raise DataError(f"{place}: not a choice of an encoder ({problem})")
        rest = {key: value for key, value in data.items() if key != "checksum"}
        if raw != _line(rest):
            raise DataError(f"{place}: is not what was written (it has its own checksum)")
        if rest["encoder"] not in rest["gains"]:
            raise DataError(f"{place}: encoder must be one of {', '.join(rest['gains']) or 'those of gains'}, got {rest['encoder']!r}")
        if found and (found[-1].final or rest["before"] <= found[-1].before):
            raise DataError(f"{place}: before must be above {found[-1].before}, that of the line above, which must not be the final one")
        gains = {name: (gain, error) for name, (gain, error) in rest["gains"].items()}
        found.append(EncoderCheck(rest["before"], EncoderChoice(rest["encoder"], rest["decisions"], gains), rest["final"]))
    if file.exists() and file.stat().st_size and not file.read_bytes().endswith(b"\n"):
        raise DataError(f"{file}: its last line is cut off; it is written whole or not at all")
    return tuple(found)


def write_checks(folder: Path, checks: Sequence[EncoderCheck]) -> None:
    """Write all lines of a run, at once or not at all, and name the encoder of the last one in `run.json`.

    Raises:
        DataError: its `run.json` cannot be read.
    """
    write_bytes(folder / CHECKS, b"".join(_line(check.to_dict()) for check in checks), sync=True)
    name_encoder(folder, checks)


def name_encoder(folder: Path, checks: Sequence[EncoderCheck]) -> None:
    """Name the encoder that a run goes on with in `run.json`, where it does not yet: the run may have been killed in between.

    Raises:
        DataError: its `run.json` cannot be read, or names an encoder that it has never had.
    """
    run = read_run(folder)
    named = run["configuration"].get("encoder")
    if not checks or named == (chosen := checks[-1].choice.encoder):
        return
    if named != checks[-1].choice.usual:
        raise DataError(f"{folder / RUN}: configuration.encoder is {named!r}, {CHECKS} beside it says {chosen!r}")
    write_json(folder / RUN, run | {"configuration": run["configuration"] | {"encoder": chosen}})


def _line(data: dict[str, Any]) -> bytes:
    return to_line({**data, "checksum": content_digest(to_line(data).encode())[:16]}).encode()
