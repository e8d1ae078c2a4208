"""A live run: a selector chooses which policy handles each instance, and learns from the reward."""

import contextlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim.api.declared import declared
from osel_sim.api.interruption import Interrupt
from osel_sim.api.results import RunResult
from osel_sim.api.run_settings import RunConfig
from osel_sim.core.errors import UnknownNameError
from osel_sim.core.trust import trusting

if TYPE_CHECKING:
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.episodes.budget_file import BudgetFile
    from osel_sim.episodes.changes import PolicyChanges
    from osel_sim.episodes.live import LiveRun
    from osel_sim.episodes.run_subscribers import RunSubscriber
    from osel_sim.formats.policy_changes import PolicyChange
    from osel_sim.interface.encoder import Encoder
    from osel_sim.interface.monitor import MonitorFactory
    from osel_sim.interface.policy import Policy
    from osel_sim.interface.selector import Selector, SelectorFactory
    from osel_sim.interface.suite import Task
    from osel_sim.policy.objects import PolicyObject
    from osel_sim.reporting.live_page import LivePage
    from osel_sim.selection.budget import Budgeted

    SelectorLike = str | SelectorFactory
    MonitorLike = str | MonitorFactory

logger = logging.getLogger(__name__)


def run(
    config: RunConfig | None = None,
    /,
    *,
    policies: "Sequence[str | Policy | PolicyObject] | None" = None,
    selector: "SelectorLike | None" = None,
    monitor: "MonitorLike | None" = None,
    subscribers: "Sequence[RunSubscriber]" = (),
    **values: Any,
) -> RunResult:
    """Let a selector choose, live in simulation, which policy handles each instance, and learn from the reward.

    Args:
        config: settings as one object; `values` change some of them.
        policies: names of policy files, or objects with `reset` and `act` (`osel_sim.as_policy` says what they are shown and cost).
        selector: name of a selector, or a class or function of one's own: called with the policies' names, the context's length and the seed.
        monitor: name of a monitor, or a class or function of one's own (`osel_sim.interface.monitor.MonitorFactory`).
        subscribers: what else watches the run (`osel_sim.episodes.run_subscribers`), beside progress, timings, TensorBoard and the page.
        values: settings by name, as `RunConfig` has them.

    Raises:
        OselError: whatever is wrong with the settings, the files they name, or what came of them; the message says what.
    """
    from osel_sim.interface.selector import factory_name
    from osel_sim.policy.objects import split_objects

    names, objects = split_objects(policies)
    if names is not None:
        values["policies"] = names
    factory = None
    if selector is not None:
        values["selector"] = selector if isinstance(selector, str) else factory_name(selector)
        factory = None if isinstance(selector, str) else selector
    watch = None
    if monitor is not None:
        values["monitor"] = monitor if isinstance(monitor, str) else factory_name(monitor)
        watch = None if isinstance(monitor, str) else monitor
    config = RunConfig.of(**values) if config is None else config.changed(**values)
    if config.resume and not config.task and config.out is not None:
        from osel_sim.api.run_resume import settings_then

        config = config.of(**settings_then(config.out) | {name: getattr(config, name) for name in config.given})
    with trusting(config.trust):
        return _Run(config, objects, factory, subscribers, watch).execute()


class _Run:
    """One call of `run`.

    Args:
        objects: policies that no file describes.
        factory: makes the selector where it is none of the registry's.
        watchers: subscribers of the caller's own.
        monitor: makes the monitor where it is none of the registry's.
    """

    def __init__(
        self,
        config: RunConfig,
        objects: "Mapping[str, PolicyObject]",
        factory: "SelectorFactory | None",
        watchers: "Sequence[RunSubscriber]",
        monitor: "MonitorFactory | None" = None,
    ) -> None:
        from osel_sim.api.reward import weights_of
        from osel_sim.api.robots import check_robots
        from osel_sim.api.run_budget import budget_of
        from osel_sim.api.run_changes import plan
        from osel_sim.api.run_encoder import check_encoder
        from osel_sim.api.run_monitor import check_monitor
        from osel_sim.api.run_resume import policies_then
        from osel_sim.episodes.drivers import choose_policies, with_fallbacks
        from osel_sim.formats.levels import parse_axes
        from osel_sim.suites.registry import common_specification, known_axes, select_tasks

        self.config, self.objects, self.factory, self.watchers, self.monitor = config, objects, factory, watchers, monitor
        if config.tensorboard:
            from osel_sim.episodes.tensorboard import check_installed

            check_installed()
        self.tasks = select_tasks(config.task, config.tasks, config.robot)
        self.environment = common_specification(self.tasks)
        names = policies_then(config.folder) if config.policies is None and config.resume else config.policies
        self.policies = choose_policies(names, self.environment, config.policies_dir, objects)
        self.everyone = with_fallbacks(self.policies, config.policies_dir)
        self.plan = plan(config, self.policies, self.environment, objects)
        self.driving = with_fallbacks(self.plan.driving, config.policies_dir) if self.plan.changes else self.everyone
        self.weights = weights_of(config)[0]
        self._check_selector()
        self.budget = budget_of(config, self.tasks, [*self.policies, *self.plan.joined.values()])
        self.sharing = check_robots(config, self.tasks, self.factory is None, objects, watchers)
        check_monitor(config, monitor, self.policies)
        check_encoder(config)
        self.axes = parse_axes(config.axis, known_axes(self.tasks))
        # Refuses an unknown level or axis before anything loads.
        drawn = (task.instance(0, level, config.split, self.axes) for task in self.tasks for level in config.level)
        self.axes_above = sorted({instance.axes for instance in drawn if instance.axes})
        self.page = self._page()
        self.spending: Budgeted | None = None
        self.spent: BudgetFile | None = None
        self.grown_from: int | None = None  # decisions that a resumed run was to have, where those are fewer

    def execute(self) -> RunResult:
        """Do it."""
        from osel_sim.api.run_resume import episodes_then
        from osel_sim.core.holding import held
        from osel_sim.formats.run_config import check_run_folder
        from osel_sim.remote.policy import check_servers

        config, folder = self.config, self.config.folder
        configuration = self._configuration()
        then = episodes_then(folder) if config.resume else None
        if then is not None and then < config.episodes:  # decisions do not depend on how many follow
            self.grown_from, configuration["episodes"] = then, then
        check_run_folder(folder, configuration, config.resume)
        check_servers(self.driving, self.environment)
        with contextlib.ExitStack() as holding:
            if config.resume:
                holding.enter_context(held(folder))
            return self._run(folder, configuration, holding)

    def _run(self, folder: Path, configuration: dict[str, Any], holding: contextlib.ExitStack) -> RunResult:
        from osel_sim.api.robot_workers import made_by
        from osel_sim.api.run_encoder import encoder_said, load_encoders
        from osel_sim.api.run_monitor import start_monitor_warm
        from osel_sim.formats.journal import JOURNAL
        from osel_sim.formats.run_config import note_growth, start_or_resume
        from osel_sim.suites.ran_with import ran_with

        config = self.config
        encoder, *others = load_encoders(config)
        configuration["encoder"] = encoder_said(config, encoder)
        seen = self._log(config.warm_start, encoder.identity) if config.warm_start else None
        machine = ran_with(self.tasks)

        from osel_sim.core.holding import taken
        from osel_sim.core.torch_settings import threads
        from osel_sim.episodes.drivers import Drivers

        # The last bits of a matrix product depend on the number of threads; one, so that a run does not depend on how many there are.
        with contextlib.ExitStack() as stack:
            stack.enter_context(threads(1))
            selector = self._selector(encoder, configuration)
            logger.info("%s: loading %s, starting servers ...", title(self.tasks), ", ".join(spec.name for spec in self.driving))
            drivers = stack.enter_context(Drivers(self.driving if config.workers == 1 else (), self.environment, self.objects))
            # Only now, when all that could be missing is there, is the folder taken into use, and given back where not even one decision comes of it.
            if not config.resume:
                holding.enter_context(taken(folder, (JOURNAL,)))
            for warning in start_or_resume(folder, configuration, machine, config.resume, config.to_json()):
                logger.warning(warning)
            live = self._live(folder, (encoder, *others), drivers, selector)
            stack.callback(live.close)
            if seen is not None:
                self._start_warm(live, seen)
            start_monitor_warm(config, live, self.grown_from)
            live.replay()
            self._write_changes(folder)
            if self.grown_from is not None:
                note_growth(folder, config.episodes)
            made = made_by(config, self.tasks, self.driving, live.subscribers)
            with Interrupt() as interrupt:
                live.run(config.episodes, lambda: interrupt.asked or (self.spending is not None and not self.spending.affordable), made)
            interrupted = interrupt.asked and len(live.decisions) < config.episodes
        return self._finish(live, interrupted)

    def _check_selector(self) -> None:
        """Refuse an unknown selector before anything heavy is loaded."""
        from osel_sim.selection.registry import selector_locations

        if self.factory is not None:
            return
        kind, _, policy = self.config.selector.partition(":")
        if kind not in selector_locations():
            raise UnknownNameError("selector", self.config.selector, selector_locations(), "fixed:POLICY for always the same one")
        names = [spec.name for spec in self.policies]
        if kind == "fixed" and policy not in names:
            raise UnknownNameError("policy", policy, names, "give --selector fixed:POLICY")
        if self.config.warm_start is not None:
            from osel_sim.analysis.warm_start import check_can_start_warm

            check_can_start_warm(kind)

    def _configuration(self) -> dict[str, Any]:
        """Everything the journal depends on but the encoder, content of files included."""
        from osel_sim.api.robots import fleet_said
        from osel_sim.api.run_budget import said
        from osel_sim.api.run_encoder import encoders_said
        from osel_sim.api.run_monitor import monitor_said
        from osel_sim.core.files import digest
        from osel_sim.formats.rollout_log import ROLLOUTS
        from osel_sim.formats.run_config import content_digests, robots_said

        config = self.config
        warm = {"warm_start": digest(config.warm_start / ROLLOUTS)} if config.warm_start else {}
        return {
            "tasks": [task.name for task in self.tasks],
            **robots_said(self.tasks),
            "episodes": config.episodes,
            "policies": [spec.name for spec in self.policies],
            "selector": config.selector,
            "seed": config.seed,
            "levels": list(config.level),
            "axes": self.axes_above,
            "action_noise": config.action_noise,
            "split": config.split,
            "reward": asdict(self.weights),
            "counterfactual": config.counterfactual,
            **({"context": config.context} if config.context else {}),
            **encoders_said(config),
            **said(self.budget),
            **fleet_said(config, self.sharing),
            **monitor_said(config),
            "content": {**content_digests(self.tasks, self.everyone), **warm},
        }

    def _selector(self, encoder: "Encoder", configuration: dict[str, Any]) -> "Selector":
        """The selector, kept within the budget where there is one."""
        from osel_sim.context.appended import LENGTH
        from osel_sim.selection.budget import Budgeted

        selector = self._free_selector(encoder, configuration)
        if self.budget is None:
            return selector
        self.spending = Budgeted(selector, self.budget, encoder.dimension + (LENGTH if self.config.context else 0), self.config.seed)
        return self.spending

    def _free_selector(self, encoder: "Encoder", configuration: dict[str, Any]) -> "Selector":
        from osel_sim.api.robots import in_turn

        return in_turn(self.config, self.sharing, self._maker(encoder, configuration))

    def _maker(self, encoder: "Encoder", configuration: dict[str, Any]) -> "Callable[[int], Selector]":
        """Makes the selector of a seed."""
        from osel_sim.context.appended import LENGTH
        from osel_sim.selection.registry import make_selector, wanted_of

        names = [spec.name for spec in self.policies]
        parts = (encoder.dimension, LENGTH) if self.config.context else (encoder.dimension,)
        if self.factory is not None:
            return partial(self.factory, names, sum(parts))
        known = declared(self.config, self.tasks, self.policies, self.weights, encoder)
        if "skills" in known:
            configuration["skills"] = known["skills"].digest if known["skills"] is not None else None
        if len(parts) > 1:
            known |= wanted_of(self.config.selector, {"parts": parts})
        return partial(make_selector, self.config.selector, names, sum(parts), **known)

    def _once_more(self, encoder: "Encoder", seed: int) -> "tuple[Selector, PolicyChanges]":
        """A selector that takes over with another encoder, and the changes of policies as it is told of them."""
        selector = self._maker(encoder, {})(seed)
        return selector, self._changes(encoder, selector)

    def _changes(self, encoder: "Encoder", selector: "Selector") -> "PolicyChanges":
        """The changes of the run, with what the selector is told of policies when they join."""
        from osel_sim.episodes.changes import PolicyChanges
        from osel_sim.selection.changing import changing

        changes = self.plan.changes
        if changes:
            changing(selector, any(change.event == "retire" for change in changes))

        def told(change: "PolicyChange") -> dict[str, Any]:
            known = self.factory is None and change.event == "add"
            return declared(self.config, self.tasks, self.plan.known_at(change), self.weights, encoder) if known else {}

        return PolicyChanges(changes, tuple(map(told, changes)))

    def _write_changes(self, folder: Path) -> None:
        """Write down what the selector has been through, before a decision is made by it."""
        from osel_sim.formats.policy_changes import note_changes, write_changes

        if self.plan.asked:
            write_changes(folder, self.plan.changes)
        elif self.plan.made:
            note_changes(folder, self.plan.made)

    def _log(self, folder: Path, encoder: str) -> "LoggedOutcomes":
        """The rollout log of a warm start."""
        from osel_sim.analysis.log import read_log

        log = read_log(folder, encoder).only([spec.name for spec in self.policies])
        return log.with_tasks() if self.config.context else log

    def _live(self, folder: Path, encoders: "tuple[Encoder, ...]", drivers: Any, selector: "Selector") -> "LiveRun":
        from osel_sim.api.run_encoder import make_trial
        from osel_sim.api.run_monitor import make_run_monitor
        from osel_sim.episodes.live import LiveOptions, LiveRun
        from osel_sim.formats.merged_policy import MERGE

        config, encoder = self.config, encoders[0]
        options = LiveOptions(
            *(config.seed, self.weights, tuple(config.level), config.split, config.counterfactual, self.axes, config.action_noise, config.context),
            changes=self._changes(encoder, selector),
            # What a merge costs depends on whose answers there were.
            prices={spec.name: spec.price for spec in (*self.policies, *self.plan.joined.values()) if spec.kind != MERGE},
            robots=config.robots,
            robots_by=config.robots_by,
            trial=make_trial(config, folder, encoders, self._once_more),
        )
        monitor = make_run_monitor(config, self.monitor, self.policies, encoder, self.weights)
        return LiveRun(folder, self.tasks, encoder, drivers, selector, options, self._subscribers(folder), monitor)

    def _subscribers(self, folder: Path) -> "list[RunSubscriber]":
        """What watches the run."""
        from osel_sim.episodes.budget_file import BudgetFile
        from osel_sim.episodes.progress import Progress
        from osel_sim.episodes.run_subscribers import Films, Paced, TimingFile
        from osel_sim.episodes.tensorboard import TensorBoard
        from osel_sim.episodes.warnings import WarningFile
        from osel_sim.reporting.view import View

        config = self.config
        films = [Films(folder, config.filmed, "full" if config.video else "fast")] if config.filmed else []
        wanted = [make() for asked, make in ((config.realtime, Paced), (config.tensorboard, TensorBoard), (config.view, View)) if asked]
        if self.spending is not None:
            self.spent = BudgetFile(self.spending, "subgoals" if self.weights.success == "subgoals" else "success", config.episodes)
        spent = [self.spent] if self.spent is not None else []
        return [TimingFile(), WarningFile(), *films, *wanted, *spent, *self.watchers, Progress(config.episodes), *([self.page] if self.page else [])]

    def _page(self) -> "LivePage | None":
        """Writes the page, if one is wanted."""
        if self.config.no_page:
            return None
        from osel_sim.reporting.live_page import LivePage

        return LivePage()

    def _start_warm(self, live: "LiveRun", log: "LoggedOutcomes") -> None:
        """Show the selector the outcomes of a rollout log, except those of instances that this run decides on."""
        from osel_sim.analysis.warm_start import WarmStart, show
        from osel_sim.api.run_resume import check_still_unseen
        from osel_sim.selection.fleet import members

        own = live.instance_keys(self.config.episodes)
        if self.grown_from is not None:
            check_still_unseen(own - live.instance_keys(self.grown_from), log.keys, log.source, self.config.episodes)
        log = log.take([row for row, key in enumerate(log.keys) if key not in own])
        for selector in members(live.selector):
            count = show(selector, WarmStart(log.contexts, log.rewards(self.weights)), selector.policies, self.config.seed)
        logger.info("shown beforehand: %d outcomes of %d instances of %s, none of them of this run", count, len(log), log.source)

    def _finish(self, live: "LiveRun", interrupted: bool) -> RunResult:
        """Write summary, curve and the selector's state."""
        from osel_sim.api.run_files import write_results

        summary = write_results(live, title(self.tasks), self.config.selector)
        if self.page is not None and self.page.problem is not None:
            logger.warning("no report.html: %s", self.page.problem)
        page, verdict = (self.page.file, self.page.verdict) if self.page else (None, "")
        spent = self.spent.spent if self.spent is not None else None
        return RunResult(live.folder, summary, tuple(live.decisions), page, interrupted, verdict, spent)


def title(tasks: "Sequence[Task]") -> str:
    """What a run's tables and figures are headed."""
    return tasks[0].name if len(tasks) == 1 else f"{len(tasks)} tasks"
