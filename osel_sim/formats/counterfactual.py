"""What became of the policies that were not chosen: `counterfactual.jsonl`, a line for each decision of the journal."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osel_sim.core.errors import DataError
from osel_sim.formats.toml_types import quoted
from osel_sim.formats.values import COUNT, NUMBER, OUTCOME, fault
from osel_sim.interface.outcome import Outcome, Seconds

COUNTERFACTUAL = "counterfactual.jsonl"


@dataclass(frozen=True)
class Others:
    """The policies that were not chosen in one decision, and what they would have come to.

    Attributes:
        index: of the decision.
        outcomes, rewards: by policy; no reward where the episode ended in error.
        alone, alone_reward: of the chosen policy without the monitor that watched it; None where none did.
    """

    index: int
    outcomes: dict[str, Outcome]
    rewards: dict[str, float | None]
    alone: Outcome | None = None
    alone_reward: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """As the file has it."""
        policies = {policy: {**outcome.to_dict(), "reward": self.rewards[policy]} for policy, outcome in self.outcomes.items()}
        alone = {} if self.alone is None else {"alone": {**self.alone.to_dict(), "reward": self.alone_reward}}
        return {"index": self.index, "policies": policies, **alone}


def to_others(data: dict[str, Any], index: int, file: Path, policies: Sequence[str], chosen: str) -> Others:
    """Check one line.

    Args:
        index: of the decision it must be of.
        policies: of the run.
        chosen: in that decision.

    Raises:
        DataError: naming file and line.
    """
    place = f"{file}, line {index + 1}: not outcomes of policies"
    if data.keys() - {"alone"} != {"index", "policies"} or not COUNT.fits(data["index"]) or not isinstance(data["policies"], dict):
        raise DataError(f"{place} (must have an index and policies, got {quoted(data)})")
    if data["index"] != index:
        raise DataError(f"{file}, line {index + 1}: index must be {index}, got {data['index']}")
    others = set(policies) - {chosen}
    if set(data["policies"]) != others:
        raise DataError(f"{place} (must be of those that were not chosen, {', '.join(sorted(others))}; got {quoted(list(data['policies']))})")
    outcomes: dict[str, Outcome] = {}
    rewards: dict[str, float | None] = {}
    for policy, values in data["policies"].items():
        outcomes[policy], rewards[policy] = _outcome(values, policy, place)
    if "alone" not in data:
        return Others(index, outcomes, rewards)
    return Others(index, outcomes, rewards, *_outcome(data["alone"], "alone", place))


def _outcome(values: Any, whose: str, place: str) -> tuple[Outcome, float | None]:
    """An outcome with its reward.

    Raises:
        DataError: naming the place, and whose it is.
    """
    if not isinstance(values, dict):
        raise DataError(f"{place} ({whose} must be an object, got {quoted(values)})")
    if problem := fault(values, {**OUTCOME, "reward": NUMBER.or_null}, optional=("fallback_steps",)):
        raise DataError(f"{place} ({whose}: {problem})")
    own = {key: value for key, value in values.items() if key != "reward"}
    return Outcome(**{**own, "seconds": Seconds(**own["seconds"])}), values["reward"]
