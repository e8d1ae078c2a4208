"""The reward as flags of the commands that weigh outcomes."""

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from osel_sim import cli

if TYPE_CHECKING:
    from osel_sim.selection.reward import RewardWeights

DEFAULT_PRESET = "oxe"
FLAGS = ("preset", "alpha_time", "alpha_price", "time_unit", "success")


def add_reward_flags(command: cli.Parser, of: str = "", live: bool = False) -> None:
    """Add `--preset`, `--alpha-time`, `--alpha-price`, `--time-unit` and, of a log, `--success`.

    Args:
        of: what to begin their help with.
        live: for episodes yet to be run, which have no score.
    """
    add = command.add_argument
    add("--preset", metavar="NAME", help=f"{of}reward weights of the paper: mmlu, waymo, alfred, oxe (default: {DEFAULT_PRESET})")
    add("--alpha-time", type=cli.non_negative_float, metavar="A", help=f"{of}weight of time in the reward (default: the preset's)")
    add("--alpha-price", type=cli.non_negative_float, metavar="A", help=f"{of}weight of the price in cents (default: the preset's)")
    add("--time-unit", choices=("log10-seconds", "steps"), help=f"{of}time in the reward (default: the preset's)")
    if not live:
        add(
            "--success",
            choices=("success", "subgoals", "score"),
            help=f"{of}what counts as success in the reward (default: the preset's, and the score of a log of --metric action-mse)",
        )


def weights_of(
    options: argparse.Namespace, metadata: Mapping[str, Any] | None = None, recorded: dict[str, Any] | None = None
) -> "tuple[RewardWeights, str | None]":
    """Weights of the reward, and the preset's name where they are a preset's.

    Args:
        metadata: of the log.
        recorded: weights of a live run, which count where no preset is named.
    """
    from dataclasses import replace

    from osel_sim.selection.reward import PRESETS, RewardWeights, preset

    base = RewardWeights(**recorded) if recorded and options.preset is None else preset(options.preset or DEFAULT_PRESET)
    given = {key: value for key in FLAGS if key != "preset" and (value := getattr(options, key, None)) is not None}
    if measured_by_score(metadata) and base.success == "success" and "success" not in given:
        # The paper's S of Open X-Embodiment is minus the action MSE; success is the score within a tolerance there.
        given["success"] = "score"
    weights = replace(base, **given)
    return weights, next((name for name, known in PRESETS.items() if known == weights), None)


def measured_by_score(metadata: Mapping[str, Any] | None) -> bool:
    """Whether a log was made by `osel_sim.ingest --metric action-mse`."""
    source = (metadata or {}).get("source")
    return isinstance(source, Mapping) and source.get("metric") == "action-mse"
