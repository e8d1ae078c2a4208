"""The settings of a live run."""

from pathlib import Path
from typing import Annotated, Literal

from osel_sim.api.robot_settings import ROBOTS, RobotSettings
from osel_sim.api.settings import (
    MAIN,
    OTHER,
    OUTPUT,
    ContentSettings,
    Count,
    Folder,
    Index,
    InstanceSettings,
    Names,
    NonNegative,
    RewardSettings,
    settings,
)

FILMED_EVERY = 5
"""Of a run that is viewed, one in so many decisions is filmed."""


@settings
class RunConfig(RobotSettings, RewardSettings, InstanceSettings, ContentSettings):
    """Let a selector choose, live in simulation, which policy handles each instance, and learn from the reward."""

    task: Annotated[Names, MAIN] = ()
    """which tasks, mixed at random: names, tag:TAG, or all; of other suites SUITE:NAME"""
    policies: Annotated[Names | None, MAIN] = None
    """policies to choose from (default: all that fit the tasks)"""
    selector: Annotated[str, MAIN] = "ppo"
    """ppo, auto, epsilon_greedy, random, fixed:POLICY ..."""
    episodes: Annotated[Count, MAIN] = 60
    """number of decisions"""
    encoder: Annotated[str | None, MAIN] = None
    """osel_small (default), osel_suite, MODEL:TAG of open_clip such as ViT-L-14:openai, MODEL:FILE, a folder, or auto: osel_small until the first
    decisions say which of those at hand predicts rewards"""
    context: Annotated[Literal["task"] | None, OTHER] = None
    """append the task's name to the contexts; auto finds out whether it helps"""
    seed: Annotated[Index, MAIN] = 0
    """of instances and selector"""
    out: Annotated[Path | None, MAIN] = None
    """where to write (default: runs/TASK-SELECTOR-sSEED)"""
    resume: Annotated[bool, MAIN] = False
    """go on with the run in --out; alone with the settings that it began with, and with --episodes to more decisions than it was to have"""
    workers: Annotated[Count, ROBOTS] = 1
    """processes that the episodes of several robots run in, with the same results for any number; each loads all policies"""
    add_policies: Annotated[Names, MAIN] = ()
    """with --resume: policies that join the run where it goes on; what the selector learned of the others stays"""
    retire: Annotated[Names, MAIN] = ()
    """with --resume: policies that are not chosen any more from where the run goes on"""
    counterfactual: Annotated[bool, MAIN] = False
    """run the other policies as well, from the same state, to compare (nothing is learnt from them)"""
    video: Annotated[Index, OUTPUT] = 0
    """film so many decisions, spread evenly over the run"""
    view: Annotated[bool, OUTPUT] = False
    """show the run in the browser while it goes on: a page on this machine that grows every few decisions, with the last film"""
    no_page: Annotated[bool, OUTPUT] = False
    """do not write the page about it, which takes some seconds; python -m osel_sim.report does so later"""
    tensorboard: Annotated[bool, OUTPUT] = False
    """also write TensorBoard event files (needs the package tensorboard)"""
    realtime: Annotated[bool, OTHER] = False
    """sleep so that the robot moves in real time"""
    budget_cents: Annotated[NonNegative | None, MAIN] = None
    """never spend more cents than that: the selector spends them where they help most, and free policies take over when they are spent"""
    budget_per: Annotated[Count | None, OTHER] = None
    """with --budget-cents: a budget for each so many decisions, one after the other (default: one for the whole run)"""
    warm_start: Annotated[Folder | None, OTHER] = None
    """rollout log whose outcomes the selector is shown first (auto, linucb, thompson ...)"""
    monitor: Annotated[str | None, OTHER] = None
    """who drives on within an episode is decided by: value, blind:K:TO, stall, random:P ... (--list)"""
    decide_every: Annotated[Count, OTHER] = 4
    """with --monitor: a decision point is every so many calls"""
    monitor_warm_start: Annotated[Folder | None, OTHER] = None
    """log with a table of moments (record --moments) that the monitor is shown first (value)"""

    @property
    def folder(self) -> Path:
        """Where to write."""
        tasks = "-".join(name.replace(":", "-").replace("/", "-") for name in self.task)
        robot = f"-{self.robot}" if self.robot else ""
        monitor = f"-{self.monitor.replace(':', '-')}" if self.monitor else ""
        return self.out or Path("runs") / f"{tasks}-{self.selector.replace(':', '-')}{monitor}-s{self.seed}{robot}"

    @property
    def filmed(self) -> frozenset[int]:
        """Indices of the decisions to film: the first, the last, and evenly between; with `view` every few, unless it is said how many."""
        if self.view and not self.video:
            return frozenset(range(0, self.episodes, FILMED_EVERY))
        count = min(self.video, self.episodes)
        if count == 1:
            return frozenset({0})
        return frozenset(round(number * (self.episodes - 1) / (count - 1)) for number in range(count))
