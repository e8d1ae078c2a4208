"""A comparison: did one policy get worse than another on the same instances?"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from annotated_types import Ge, Le, MinLen
from pydantic import BeforeValidator

from osel_sim.api.results import CompareResult
from osel_sim.api.reward import weights_of
from osel_sim.api.settings import MAIN, OUTPUT, Folder, LoggedRewardSettings, Names, settings
from osel_sim.core.errors import UsageError

if TYPE_CHECKING:
    from osel_sim.analysis.pairing import Contender


def _one_or_many(value: Any) -> Any:
    return (value,) if isinstance(value, str | Path) else value


@settings
class CompareConfig(LoggedRewardSettings):
    """Did a policy get worse? Policies on the same instances, with paired intervals and a verdict."""

    logs: Annotated[tuple[Folder, ...], MinLen(1), BeforeValidator(_one_or_many)]
    """rollout log, live run, or several of them; the first is what the others are compared with"""
    policies: Annotated[Names | None, MAIN] = None
    """of one log: what to compare, the first being what the others are compared with (default: all); of several: one in all, or one of each"""
    margin: Annotated[float, Ge(0.0), Le(1.0), MAIN] = 0.05
    """how much lower success may be to count as no worse; 0.05 is 5 points"""
    plan: Annotated[bool, MAIN] = False
    """say how many instances it takes to find a difference, instead of comparing"""
    detect: Annotated[float, Ge(0.001), Le(1.0), MAIN] = 0.05
    """difference of success to plan for"""
    power: Annotated[float, Ge(0.5), Le(0.99), MAIN] = 0.8
    """probability with which the instances that are said to be needed tell"""
    out: Annotated[Path | None, OUTPUT] = None
    """folder for compare.json and its page (default: none is written)"""
    overwrite: Annotated[bool, OUTPUT] = False
    """replace a comparison that is in --out"""
    open: Annotated[bool, OUTPUT] = False
    """show the page in the browser"""
    markdown: Annotated[Path | None, OUTPUT] = None
    """file for the tables as Markdown, as for a pull request"""
    junit: Annotated[Path | None, OUTPUT] = None
    """file for the verdicts as JUnit XML"""


def compare(*logs: "Path | str | CompareConfig", **values: Any) -> CompareResult:
    """Compare policies on the instances on which all have outcomes, pair by pair.

    Args:
        logs: folders of rollout logs or live runs, the first of which is what the others are compared with; or all settings as one object, of which
            `values` change some.
        values: settings by name, as `CompareConfig` has them.

    Raises:
        OselError: whatever is wrong with the settings or the logs; nothing can be paired. The message says what.
    """
    from osel_sim.analysis.comparison import compare as compared
    from osel_sim.analysis.comparison import plan
    from osel_sim.formats.compare_result import check_compare_folder, check_file, write_compare, write_report
    from osel_sim.reporting.comparison import junit, markdown

    config = _configuration(logs, values)
    if "detect" in config.given and not config.plan:
        raise UsageError("--detect is what --plan plans for; add --plan, or leave it out")
    if config.plan and (config.markdown is not None or config.junit is not None):
        raise UsageError("--plan compares nothing, so there is no --markdown or --junit of it")
    if config.open and (config.out is None or config.plan):
        raise UsageError("--open shows the page of a comparison, which lies in --out: give that, and leave --plan out")
    if config.out is not None:
        check_compare_folder(config.out, config.overwrite)
    for flag, file in (("--markdown", config.markdown), ("--junit", config.junit)):
        if file is not None:
            check_file(flag, file)
    contenders = _contenders(config)
    weights, _ = weights_of(config, contenders[0].log.metadata, _recorded(contenders[0]))
    if config.plan:
        result: dict[str, Any] = {"plan": plan(contenders, weights, config.detect, config.margin, config.power)}
    else:
        result = compared(contenders, weights, config.margin, config.power)
    if config.out is not None:
        write_compare(config.out, result)
        if not config.plan:
            _show(config, result)
    if config.markdown is not None:
        write_report("--markdown", config.markdown, markdown(result))
    if config.junit is not None:
        write_report("--junit", config.junit, junit(result))
    return CompareResult(config.out, result)


def _show(config: CompareConfig, result: dict[str, Any]) -> None:
    """Write the page beside `compare.json`, and open it if that was asked for."""
    from osel_sim.reporting.compare_page import page_of
    from osel_sim.reporting.page import write_page

    folder = cast(Path, config.out)
    try:
        page = write_page(page_of(result, folder), folder)
    except OSError as error:
        raise UsageError(f"--out {folder} cannot be written ({error.strerror})") from None
    if config.open:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())


def _recorded(first: "Contender") -> dict[str, Any] | None:
    """Weights that a live run was made with; a rollout log has none."""
    from dataclasses import asdict

    from osel_sim.analysis.live import is_live_run
    from osel_sim.formats.run_config import RUN
    from osel_sim.selection.reward import weights_from

    source = first.log.source
    return asdict(weights_from(first.log.metadata["reward"], f"{source / RUN}: configuration.reward")) if is_live_run(source) else None


def _configuration(logs: "tuple[Path | str | CompareConfig, ...]", values: dict[str, Any]) -> CompareConfig:
    if len(logs) == 1 and isinstance(logs[0], CompareConfig):
        return logs[0].changed(**values)
    return CompareConfig.of(**({"logs": logs} if logs else {}), **values)


def _contenders(config: CompareConfig) -> "list[Contender]":
    """Who is compared, in order.

    Raises:
        UsageError: fewer than two, one twice, or several policies in one of several logs and none named.
        UnknownNameError: a log does not have a policy.
    """
    from osel_sim.analysis.pairing import Contender, read_contender_log

    logs = [read_contender_log(folder) for folder in config.logs]
    if len(logs) == 1:
        policies = config.policies or logs[0].policies
        if len(policies) < 2:
            raise UsageError(f"{logs[0].source}: one policy, {', '.join(policies)}, is compared with nothing: name another, or give another log")
        return [Contender(name, name, logs[0]) for name in logs[0].only(policies).policies]
    if config.policies is None:
        for log in logs:
            if len(log.policies) > 1:
                raise UsageError(f"{log.source} has several policies, {', '.join(log.policies)}: name one with --policies")
        chosen = [log.policies[0] for log in logs]
    else:
        chosen = list(config.policies) * (len(logs) if len(config.policies) == 1 else 1)
        if len(chosen) != len(logs):
            raise UsageError(f"--policies: {len(logs)} logs need one name for all, or one each; got {', '.join(config.policies)}")
    for name, log in zip(chosen, logs, strict=True):
        log.only([name])
    names = [name if chosen.count(name) == 1 else f"{name}@{log.source}" for name, log in zip(chosen, logs, strict=True)]
    places = [(log.source.resolve(), name) for name, log in zip(chosen, logs, strict=True)]
    if twice := next((place for place in places if places.count(place) > 1), None):
        raise UsageError(f"{twice[1]} of {twice[0]} is given twice: it is not compared with itself")
    return [Contender(*parts) for parts in zip(names, chosen, logs, strict=True)]
