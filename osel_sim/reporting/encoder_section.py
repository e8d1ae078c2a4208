"""Which encoder a live run went on with, and by what evidence."""

from pathlib import Path

from osel_sim.formats.encoder_checks import read_checks
from osel_sim.reporting.html_tables import Cell, Column, Table
from osel_sim.reporting.page import Section

CAPTION = (
    "Reward that a router has over the best single policy: ridge regression, nearest neighbours or trees on the encoder's contexts, learned on four "
    "fifths of the decisions so far and scored on the fifth, of what came of the chosen policies, weighted by how rarely each is chosen. The usual "
    "encoder, named first, stays unless another is ahead of it, and of the best single policy, by more than the standard error. Then the selector is "
    "told all decisions so far again with that one's contexts."
)


def encoder_section(folder: Path) -> list[Section]:
    """What the run found each time that it asked, as a table and in words; nothing where it was told its encoder, or has not asked yet."""
    checks = read_checks(folder)
    rows: list[dict[str, Cell]] = [
        {
            "before": check.before,
            "encoder": name,
            "gain": gain,
            "error": error,
            "decisions": check.choice.instances,
            "taken": "yes" if name == check.choice.encoder else "",
        }
        for check in checks
        for name, (gain, error) in check.choice.gains.items()
    ]
    columns = [
        *(Column("before", "asked before decision", digits=0), Column("encoder", "encoder", "text"), Column("decisions", "decisions", digits=0)),
        *(Column("gain", "gain over the best single policy", digits=4), Column("error", "standard error", digits=4)),
        Column("taken", "goes on with it", "text"),
    ]
    told = [f"{check.words[0].upper()}{check.words[1:]}." for check in checks[-1:]]
    return [Section("encoder", "Encoder", [*told, Table("encoders", "Which encoder predicts rewards", CAPTION, columns, rows)])] if checks else []
