"""What came of a replay of moments, as the tables that are written beside it."""

from collections.abc import Mapping
from typing import Any


def tables(result: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """The CSV files, by name: a row an arm, and a row a task, first policy, second policy and decision point."""
    arms = []
    for arm in result["arms"]:
        row: dict[str, Any] = {"start": arm["start"], "monitor": arm["monitor"]}
        for name in ("reward", "success", "price", "seconds", "gain", "gain_success", "gain_price"):
            row |= dict(zip((name, f"{name}_low", f"{name}_high"), arm.get(name) or (None,) * 3, strict=True))
        row |= {name: arm.get(name) for name in ("duty", "recovered", "harmed", "p", "p_holm", "p_reward", "p_reward_holm", "of_gap")}
        arms.append(row)
    gains = [{**gain, "gain": gain["gain"]["value"], "gain_low": gain["gain"]["low"], "gain_high": gain["gain"]["high"]} for gain in result["gains"]]
    return {"arms": arms, "gains": gains}
