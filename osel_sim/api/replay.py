"""A replay: a rollout log's instances shown to selectors in random orders, and what each earns."""

import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from osel_sim.api.replay_settings import ReplayConfig, choose_selectors
from osel_sim.api.results import MomentsResult, ReplayResult
from osel_sim.api.reward import weights_of
from osel_sim.core.errors import DataError, SettingError, UnknownNameError, UsageError

if TYPE_CHECKING:
    from osel_sim.analysis.budgets import BudgetPlan
    from osel_sim.analysis.encoder_choice import EncoderChoice
    from osel_sim.analysis.engine import Setup
    from osel_sim.analysis.frontier import FrontierPlan
    from osel_sim.analysis.live import LiveLog
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.analysis.oracles import Oracles
    from osel_sim.analysis.sharing import Robots
    from osel_sim.analysis.streams import LeftOut
    from osel_sim.analysis.targets import Target
    from osel_sim.formats.replay_result import Choices
    from osel_sim.interface.selector import SelectorFactory
    from osel_sim.selection.reward import RewardWeights

logger = logging.getLogger(__name__)

SOONEST = ("auto", "linucb")
"""Selectors that are replayed first: they take seconds where PPO takes minutes, and the verdict hardly ever changes with the others."""
WARM_SOON = 15_000
"""Up to so many decisions, those of all seeds, `auto:warm` is replayed with them; beyond it the first verdict takes more than 20 s on two cores."""


def replay(
    log: "Path | str | ReplayConfig",
    *,
    selectors: "str | Sequence[str | SelectorFactory] | None" = None,
    targets: "Mapping[str, Target] | Sequence[Path | str] | Path | str | None" = None,
    on_result: Callable[[ReplayResult], None] | None = None,
    **values: Any,
) -> ReplayResult | MomentsResult:
    """Show a log's instances in random orders to selectors, each of which sees only the outcome of its choice.

    Args:
        log: folder of a rollout log or of a live run; or all settings as one object, of which `values` change some.
        selectors: names, or classes or functions of one's own: called with the policies' names, the context's length and the seed.
        targets: of a live run, or of logged decisions: tables, or functions by name, of ways of choosing of one's own, whose reward is estimated
            too. A function is called with an instance and its context and returns policy -> probability.
        on_result: called whenever more is there and written: with the verdict from `auto` and `linucb`, with that from all selectors, and with the
            frontier. What is yet to come, `ReplayResult.pending` says.
        values: settings by name, as `ReplayConfig` has them.

    Returns:
        what came of it; of the folder of a table of moments (`record --moments`), monitors and start selectors compared.

    Raises:
        OselError: whatever is wrong with the settings or the log; the message says what.
    """
    from osel_sim.api.replay_moments import has_moments, replay_moments
    from osel_sim.interface.selector import factory_name

    factories: dict[str, SelectorFactory] = {}
    if isinstance(selectors, str):
        selectors = [selectors]
    if selectors is not None:
        factories = {factory_name(selector): selector for selector in selectors if not isinstance(selector, str)}
        values["selectors"] = [selector if isinstance(selector, str) else factory_name(selector) for selector in selectors]
    functions = targets if isinstance(targets, Mapping) else {}
    if targets is not None and not isinstance(targets, Mapping):
        values["targets"] = targets
    config = log.changed(**values) if isinstance(log, ReplayConfig) else ReplayConfig.of(log=Path(log), **values)
    if has_moments(config.log):
        return replay_moments(config, factories, functions)
    if config.monitors:
        raise SettingError("monitors", f"{config.log} holds no table of moments (record --moments makes one); leave the flag out")
    return _Replay(config, factories, functions, on_result).execute()


@dataclass(frozen=True)
class _Material:
    """What is replayed, and what is known of it beforehand.

    Attributes:
        log: complete instances only.
        setup: what selectors are told and shown.
        left_out: instances that are not complete.
        preset: name of the reward's weights, if they have one.
        choice: how the encoder was chosen, where it was.
        off_policy: estimates from a live run's propensities.
    """

    log: "LoggedOutcomes"
    setup: "Setup"
    selectors: Sequence[str]
    left_out: "LeftOut"
    preset: str | None
    choice: "EncoderChoice | None"
    off_policy: dict[str, Any] | None

    def result(self, config: ReplayConfig, choices: "Choices", best: "Oracles") -> dict[str, Any]:
        """What `replay.json` has of these choices."""
        from osel_sim.analysis.result import Question, build

        question = Question(config.margin, config.half is not None, config.route_with)
        result = build(self.log, self.setup.weights, self.preset, choices, best, self.left_out, range(config.seeds), question)
        result["log"] |= {"half": config.half, "context": config.context}
        result["log"]["encoder_choice"] = None if self.choice is None else {"text": str(self.choice), **asdict(self.choice)}
        return result | {"off_policy": self.off_policy} | _told(self.setup)


@dataclass(frozen=True)
class _Replay:
    """One call of `replay`."""

    config: ReplayConfig
    factories: "Mapping[str, SelectorFactory]"
    targets: "Mapping[str, Target]"
    on_result: Callable[[ReplayResult], None] | None

    def execute(self) -> ReplayResult:
        """Do it."""
        from osel_sim.analysis.encoder_choice import AUTO, with_best_encoder
        from osel_sim.analysis.live import is_live_run, read_live
        from osel_sim.analysis.log import read_log
        from osel_sim.analysis.logged_choices import choices_of, has_choices
        from osel_sim.api.replay_budgets import check_budget
        from osel_sim.api.replay_changes import check_all_outcomes, check_changes
        from osel_sim.formats.replay_result import check_replay_folder, write_off_policy

        config, folder = self.config, self.config.folder
        named = None if config.selectors is None else [name for name in config.selectors if name not in self.factories]
        selectors = [*choose_selectors(named, halved=config.half is not None), *self.factories]
        for name in config.route_with or ():
            if name not in selectors or name == "random":
                raise UnknownNameError("selector", name, set(selectors) - {"random"}, "--route-with names selectors that are replayed")
        check_replay_folder(folder, config.overwrite)
        self._robots(selectors)  # refuses what cannot be, before anything is read
        check_budget(config, True)
        check_changes(config)
        if not is_live_run(config.log):
            log = read_log(config.log, None if config.encoder == AUTO else config.encoder)
            weights, preset = weights_of(config, log.metadata)
            if not has_choices(log):
                if config.targets or self.targets:
                    raise UsageError(f"{log.source} has the outcomes of every policy: a target is estimated from a live run or from logged decisions")
                log, choice = with_best_encoder(log, weights) if config.encoder == AUTO else (log, None)
                return self._replay(selectors, log, weights, preset, choice)
            live = choices_of(log)
        elif config.encoder == AUTO:
            raise UsageError(f"--encoder {AUTO} is for rollout logs: {config.log} is a live run, whose selector saw one encoder's contexts")
        else:
            live = read_live(config.log, config.encoder)
            weights, preset = weights_of(config, recorded=live.reward)
        found, whole = self._off_policy(live, weights), live.has_all_outcomes(weights)
        check_all_outcomes(config, whole)
        check_budget(config, whole)
        if whole:
            return self._replay(selectors, live.outcomes, weights, preset, off_policy=found)
        if config.robots > 1:
            raise UsageError(f"--robots {config.robots} needs the outcomes of every policy, and {config.log} has only those of what was chosen")
        write_off_policy(folder, found)
        return self._tell(ReplayResult(folder, off_policy=found), config.log, True)

    def _replay(
        self,
        selectors: Sequence[str],
        log: "LoggedOutcomes",
        weights: "RewardWeights",
        preset: str | None,
        choice: "EncoderChoice | None" = None,
        off_policy: dict[str, Any] | None = None,
    ) -> ReplayResult:
        """Prepare what is replayed, and replay it."""
        from osel_sim.api.replay_budgets import plan_budgets_of
        from osel_sim.api.replay_changes import changes_asked, replay_changes

        config = self.config
        if config.context:
            log = log.with_tasks()
        log, others, left_out = self._instances(log, weights)
        setup = self._setups(log, others, selectors)
        here = setup(weights)
        if changes_asked(config):
            shared = config, log, here, selectors, left_out, preset, self.factories
            return replay_changes(*shared, lambda done: self._tell(done, config.folder, True))
        plan = None if config.no_frontier else self._plan_frontier(log, setup, weights, selectors)
        budgets = plan_budgets_of(config, log, here, selectors)
        return self._by_stages(_Material(log, here, selectors, left_out, preset, choice, off_policy), budgets, plan)

    def _by_stages(self, material: "_Material", budgets: "BudgetPlan | None", plan: "FrontierPlan | None") -> ReplayResult:
        """Replay what a verdict needs, all other selectors, within budgets, at other weights, and to robots. Each is written and told."""
        from osel_sim.analysis.engine import Part, replay_parts
        from osel_sim.analysis.oracles import oracles
        from osel_sim.analysis.result import tables, with_fixed
        from osel_sim.api.robots import replay_robots
        from osel_sim.core.progress import progress
        from osel_sim.formats.replay_result import BUDGET, FRONTIER, PENDING, SHARING, write_replay

        config, log, here, selectors, off_policy = self.config, material.log, material.setup, material.selectors, material.off_policy
        seeds, robots = range(config.seeds), self._robots(selectors)
        stages = [Part(log, [here], names, seeds, config.decisions) for names in _stages(selectors, len(seeds) * (config.decisions or len(log)))]
        parts = [*stages, *([] if budgets is None else [budgets.part]), *([] if plan is None else [plan.part])]
        done, chosen, result = ReplayResult(config.folder), dict[str, Any](), dict[str, Any]()
        with (
            progress(sum(part.total for part in parts), "decision", scale=True) as bar,
            closing(replay_parts(parts, config.workers, bar.update, self.factories)) as replayed,
            ThreadPoolExecutor(1) as beside,
        ):
            bounds = beside.submit(oracles, log, here.weights)  # while workers begin
            if config.workers == 1:
                bounds.result()  # what is replayed in this process limits its threads, on which last bits depend
            for part, made in zip(parts, replayed, strict=True):
                if plan is not None and part is plan.part:
                    result[FRONTIER] = plan.frontiers(made)
                elif budgets is not None and part is budgets.part:
                    result[BUDGET] = budgets.measured(made)
                else:
                    chosen |= made[0].chosen
                    known = {name: chosen[name] for name in selectors if name in chosen}
                    best = bounds.result()
                    choices = with_fixed(replace(made[0], chosen=known), best)
                    result = material.result(config, choices, best)
                pending = [name for name in selectors if name not in chosen]
                pending += [BUDGET] if budgets is not None and BUDGET not in result else []
                pending += [FRONTIER] if plan is not None and part is not plan.part else []
                pending += [SHARING] if robots is not None else []
                whole = {**result, PENDING: pending} if pending else result
                with bar.aside():
                    write_replay(config.folder, whole, choices, tables(result))
                    done = self._tell(ReplayResult(config.folder, whole, off_policy), config.folder, part is parts[0])
        if robots is None:
            return done
        result[SHARING] = replay_robots(log, here, *robots, config, self.factories)
        write_replay(config.folder, result, choices, tables(result))
        return self._tell(ReplayResult(config.folder, result, off_policy), config.folder, False)

    def _robots(self, selectors: Sequence[str]) -> "tuple[list[str], Robots] | None":
        """Selectors of the robots, and what they share; None where there is one robot."""
        from osel_sim.api.replay_changes import changes_asked
        from osel_sim.api.robots import robots_asked

        asked = robots_asked(self.config, selectors, named=self.config.selectors is not None, own=self.factories, decisions=self.config.decisions)
        if asked is not None and changes_asked(self.config):
            raise UsageError("--robots is for streams that do not change: leave out --join, --leave and --drift, or --robots")
        return asked

    def _tell(self, result: ReplayResult, page_of: Path, first: bool) -> ReplayResult:
        if self.on_result is not None:
            self.on_result(result)
        if self.config.open:
            from osel_sim.api.report import report

            report(page_of, open=first)
        return result

    def _instances(self, log: "LoggedOutcomes", weights: "RewardWeights") -> "tuple[LoggedOutcomes, LoggedOutcomes, Any]":
        """What is replayed; what costs are known from and warm starts are shown (the other half, where one is replayed); what is left out."""
        from osel_sim.analysis.streams import complete_instances
        from osel_sim.formats.rollout_log import DECLARED

        config = self.config
        if config.policies:
            log = log.only(config.policies)
        others = log
        if config.half:
            mine = log.half(config.half)
            if not mine.any():
                raise UsageError(f"--half {config.half}: none of the {len(log)} instances of {log.source} is in that half; leave the flag out")
            log, others = log.take(mine), log.take(~mine)
        log, left_out = complete_instances(log, weights)
        if left_out.instances:
            logger.warning("%d instances without an outcome of every policy are left out", left_out.instances)
        if log.skills is None and log.metadata.get(DECLARED) and not config.unknown_skills:
            logger.warning(
                "auto is not told what policies were made for: %s lacks examples of it in the contexts of %s; "
                "python -m osel_sim.record --resume --out %s --encoder %s adds them",
                *(log.source, log.encoder, log.source, log.encoder.partition("@")[0]),
            )
        return log, others, left_out

    def _setups(self, log: "LoggedOutcomes", others: "LoggedOutcomes", selectors: Sequence[str]) -> "Callable[[RewardWeights], Setup]":
        """Under what to replay at any weights: what selectors are told, and shown before their stream begins."""
        from osel_sim.analysis.engine import Setup
        from osel_sim.analysis.told import told
        from osel_sim.analysis.warm_start import WarmStart

        config, named = self.config, [name for name in selectors if name not in self.factories]

        def setup(weights: "RewardWeights") -> Setup:
            warm_start = WarmStart(others.contexts, others.rewards(weights)) if config.half else None
            return Setup(weights, told(log, others, weights, named, not config.unknown_costs, not config.unknown_skills), warm_start)

        return setup

    def _plan_frontier(
        self, log: "LoggedOutcomes", setup: "Callable[[RewardWeights], Setup]", weights: "RewardWeights", selectors: Sequence[str]
    ) -> "FrontierPlan | None":
        from osel_sim.analysis.frontier import plan_frontiers

        learners = [name for name in selectors if name != "random" and name not in self.factories]
        if not learners:
            return None
        try:
            return plan_frontiers(log, setup, weights, learners, self.config.seeds, self.config.decisions)
        except DataError as error:
            logger.warning("no frontier of selectors: %s", error)
            return None

    def _off_policy(self, live: "LiveLog", weights: "RewardWeights") -> dict[str, Any]:
        """Estimates from a live run's propensities."""
        from osel_sim.analysis.evaluation import evaluate
        from osel_sim.analysis.targets import check_names, probabilities_of
        from osel_sim.ingestion.target_tables import read_target

        if self.config.policies or self.config.half:
            raise UsageError("--policies and --half are for rollout logs: decisions that were made are evaluated as they were made")
        log = live.outcomes
        check_names([*(file.stem for file in self.config.targets), *self.targets], log.policies)
        own = {file.stem: read_target(file, log.keys, log.policies) for file in self.config.targets}
        own |= {name: probabilities_of(name, target, live) for name, target in self.targets.items()}
        return evaluate(live, weights, own)


def _stages(selectors: Sequence[str], decisions: int) -> list[list[str]]:
    """Those that a verdict comes of soonest, and all others; where there is nothing to tell apart, all in one.

    Args:
        decisions: of each selector, in all seeds.
    """
    soonest = (*SOONEST, "auto:warm") if decisions <= WARM_SOON else SOONEST
    first = [name for name in selectors if name in soonest]
    return [names for names in (first, [name for name in selectors if name not in first]) if names] or [[]]


def _told(setup: "Setup") -> dict[str, Any]:
    """What selectors were told, as `replay.json` has it."""
    from osel_sim.analysis.told import COSTS, SKILLS

    told = setup.settings.values()
    skills = next((settings[SKILLS] for settings in told if SKILLS in settings), None)
    return {
        "expected_costs": next((dict(settings[COSTS]) for settings in told if COSTS in settings), None),
        "skills": None if skills is None else {policy: list(names) for policy, names in skills.able.items()},
    }
