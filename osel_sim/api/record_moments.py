"""A recording with moments: what it asks for, and what it is refused."""

from collections.abc import Iterable, Mapping, Set
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim.core.errors import SettingError

if TYPE_CHECKING:
    from osel_sim.api.record_settings import RecordConfig
    from osel_sim.episodes.moments import Cuts
    from osel_sim.episodes.workers import Plan
    from osel_sim.interface.instance import Instance

_SETTINGS = {"moments": "every", "most_moments": "most"}
"""Setting -> key of `moments` in run.json."""
BLOCK = 1
"""So many instances of each task and level are recorded before those of the next task, for the sake of recordings that are interrupted."""


def cuts_of(config: "RecordConfig") -> "Cuts | None":
    """Where episodes are to be cut; None: nowhere.

    Raises:
        SettingError: a setting that goes only with moments, or not with them.
    """
    from osel_sim.episodes.moments import Cuts

    if config.moments is None:
        if config.most_moments is not None:
            raise SettingError("most_moments", "is for a recording with moments; add --moments K, or leave it out")
        return None
    if config.until_decided:
        raise SettingError("moments", "does not go with --until-decided, which stops before all instances have theirs; leave one of them out")
    return Cuts(config.moments, config.most_moments)


def check_moments(plan: "Plan") -> None:
    """Refuse moments of tasks that have no snapshots, and of a single policy.

    Raises:
        SettingError: naming the task.
    """
    if plan.cuts is None:
        return
    for task in plan.tasks:
        if not task.specification.snapshots:
            raise SettingError("moments", f"{task.name} cannot go back to a moment of an episode: its suite has no snapshots")
    if len(plan.policies) < 2:
        raise SettingError("moments", f"{plan.policies[0].name} alone has nobody to hand over to: name another policy after --policies")


def said_of(cuts: "Cuts | None") -> dict[str, Any]:
    """What run.json and the log say of it; nothing where there are no moments."""
    return {} if cuts is None else {"moments": {"every": cuts.every, "most": cuts.most}}


def as_begun(config: "RecordConfig", given: Set[str], began: Mapping[str, Any], run: Path) -> dict[str, Any]:
    """The settings of moments that a recording began with.

    Raises:
        SettingError: others were given, or a policy or an encoder that its moments do not have.
        KeyError, TypeError: run.json has another form.
    """
    then = began.get("moments")
    for name, key in _SETTINGS.items():
        was = None if then is None else then[key]
        if name in given and getattr(config, name) != was:
            raise SettingError(name, f"{getattr(config, name)}, but {run} began with {was}; leave it out, or give another --out")
    if then is None:
        return {}
    if added := [name for name in config.policies or () if name not in began["policies"]]:
        raise SettingError(
            "policies", f"{added[0]}: {run} has moments of {', '.join(began['policies'])}, and episodes that are there would lack those of another"
        )
    if config.encoder is not None and config.encoder not in (began["encoder"], began["encoder"].partition("@")[0]):
        raise SettingError("encoder", f"{config.encoder}, but {run} has pictures of {began['encoder']}; give another --out")
    return {name: then[key] for name, key in _SETTINGS.items()}


def in_blocks(instances: "Iterable[str]", plan: "Plan") -> list[str]:
    """Some instances of each task in turn, so that what is there of a recording that was interrupted is of all tasks."""
    size = BLOCK * len(plan.levels)
    tasks = {task.name: number for number, task in enumerate(plan.tasks)}

    def place(key: str) -> tuple[int, int, int]:
        instance: Instance = plan.instances[key]
        return (instance.seed - plan.seeds.start) // size, tasks[instance.task], instance.seed

    return sorted(instances, key=place)
