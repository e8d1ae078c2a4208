"""Policies that join and leave a live run that goes on: what was changed before, and what is asked for now."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from osel_sim.core.errors import UnknownNameError, UsageError

if TYPE_CHECKING:
    from osel_sim.api.run_settings import RunConfig
    from osel_sim.formats.policy_changes import PolicyChange
    from osel_sim.formats.policy_file import PolicySpec
    from osel_sim.interface.environment import EnvironmentSpec
    from osel_sim.policy.objects import PolicyObject


@dataclass(frozen=True)
class Plan:
    """What becomes of a run's policies.

    Attributes:
        initial: files of those that it began with.
        made: changes of its earlier processes.
        asked: those to be made now.
        joined: files of the policies that ever joined, by name.
        decisions: how many the journal has.
    """

    initial: "tuple[PolicySpec, ...]"
    made: "tuple[PolicyChange, ...]" = ()
    asked: "tuple[PolicyChange, ...]" = ()
    joined: "Mapping[str, PolicySpec]" = field(default_factory=dict)
    decisions: int = 0

    @property
    def changes(self) -> "tuple[PolicyChange, ...]":
        """All of them."""
        return (*self.made, *self.asked)

    @property
    def driving(self) -> "list[PolicySpec]":
        """Policies that may still have to drive: what has retired for good need not be loaded."""
        from osel_sim.formats.policy_changes import available

        names = [spec.name for spec in self.initial]
        later = [change for change in self.changes if change.before >= self.decisions]
        needed = {*available(names, self.changes, self.decisions), *(change.policy for change in later)}
        specs = {spec.name: spec for spec in self.initial} | dict(self.joined)
        return [spec for name, spec in specs.items() if name in needed]

    def known_at(self, change: "PolicyChange") -> "list[PolicySpec]":
        """All policies that had ever joined once a change was made: what a selector is told of then."""
        until = self.changes[: self.changes.index(change) + 1]
        names = dict.fromkeys(made.policy for made in until if made.event == "add")
        own = {spec.name: spec for spec in self.initial}
        return [*self.initial, *(self.joined[name] for name in names if name not in own)]


def plan(config: "RunConfig", initial: "Sequence[PolicySpec]", environment: "EnvironmentSpec", objects: "Mapping[str, PolicyObject]") -> Plan:
    """What was changed in the run's folder before, and what is to be changed now.

    Raises:
        UsageError: a change that cannot be made, or the file of a policy that joined is another one by now.
        DataError: the folder's files are damaged.
    """
    from osel_sim.formats.journal import JOURNAL, LOST
    from osel_sim.formats.policy_changes import EVENTS, read_changes

    if not config.resume:
        for flag, given in (("add-policies", config.add_policies), ("retire", config.retire)):
            if given:
                raise UsageError(f"--{flag} is for a run that goes on: add --resume and its --out, or name the policies of a new run with --policies")
        return Plan(tuple(initial))
    names, file = [spec.name for spec in initial], config.folder / JOURNAL
    made = read_changes(config.folder, names)
    decisions = file.read_bytes().count(b"\n") if file.is_file() else 0
    for flag, fixed in (("--monitor", config.monitor is not None), ("--robots", config.robots > 1)):
        if fixed and (config.add_policies or config.retire):
            raise UsageError(f"policies of a run with {flag} do not come and go; begin a new run with the policies that there are now")
    asked = _asked(config, names, made, decisions, environment, objects)
    if asked and made and made[-1].before > decisions:
        raise UsageError(f"{config.folder / EVENTS}: {made[-1].words}, {JOURNAL} beside it has {decisions}: {LOST}; --resume alone makes them again")
    if asked and decisions >= config.episodes:
        raise UsageError(f"the run has made all its {decisions} decisions: say with --episodes to how many it is to go on")
    own = {spec.name for spec in initial}
    joined = {
        change.policy: _spec(change.policy, config, environment, objects)
        for change in (*made, *asked)
        if change.event == "add" and change.policy not in own
    }
    for change in made:
        if change.event == "add" and change.policy in joined:
            _check_same(change, joined[change.policy], config)
    return Plan(tuple(initial), made, asked, joined, decisions)


def _asked(
    config: "RunConfig",
    initial: Sequence[str],
    made: "Sequence[PolicyChange]",
    decisions: int,
    environment: "EnvironmentSpec",
    objects: "Mapping[str, PolicyObject]",
) -> "tuple[PolicyChange, ...]":
    """The changes that the settings ask for, those that join first."""
    from osel_sim.formats.policy_changes import PolicyChange, available, check_change

    for flag, names in (("add-policies", config.add_policies), ("retire", config.retire)):
        for name in names:
            if names.count(name) > 1:
                raise UsageError(f"policy {name!r} is named twice after --{flag}")
            if name in config.add_policies and name in config.retire:
                raise UsageError(f"policy {name!r} is named after --add-policies and after --retire: leave one of them out")
    found: list[PolicyChange] = []
    for name in config.add_policies:
        there = available(initial, (*made, *found))
        if name in there:
            joined = next((change for change in reversed(made) if change.policy == name), None)
            since = f"since decision {joined.before}" if joined else "from the beginning"
            raise UsageError(f"--add-policies {name}: the run has had it {since} (it has {', '.join(there)}); leave the flag out to go on")
        content = _content(_spec(name, config, environment, objects), config)
        found.append(PolicyChange(decisions, "add", name, content))
    for name in config.retire:
        there = available(initial, (*made, *found))
        change = PolicyChange(decisions, "retire", name, {})
        kind, _, always = config.selector.partition(":")
        if kind == "fixed" and name == always and name in there:
            raise UsageError(f"--retire {name}: the run's selector {config.selector} chooses no other; begin a new run with another selector")
        if name not in there:
            raise UnknownNameError("policy", name, there, "the run's policies, of which --retire takes one out")
        check_change(change, there)
        found.append(change)
    return tuple(found)


def _spec(name: str, config: "RunConfig", environment: "EnvironmentSpec", objects: "Mapping[str, PolicyObject]") -> "PolicySpec":
    from osel_sim.episodes.drivers import choose_policies

    [spec] = choose_policies([name], environment, config.policies_dir, objects)
    return spec


def _content(spec: "PolicySpec", config: "RunConfig") -> dict[str, str | None]:
    """What the files of a policy that joins hold, those of its fallback included."""
    from osel_sim.episodes.drivers import with_fallbacks
    from osel_sim.formats.run_config import content_digests

    return dict(content_digests((), with_fallbacks([spec], config.policies_dir)))


def _check_same(change: "PolicyChange", spec: "PolicySpec", config: "RunConfig") -> None:
    from osel_sim.formats.policy_changes import EVENTS

    now = _content(spec, config)
    for key in {**change.content, **now}:
        if change.content.get(key) != now.get(key):
            raise UsageError(
                f"{config.folder / EVENTS}: {key} was {change.content.get(key)!r} when {change.policy} joined, now it is {now.get(key)!r}; "
                "resume with the same, or give another --out"
            )
