"""Replay a rollout log to selectors: `python -m osel_sim.replay assets/logs/pick_place`."""

import sys

from osel_sim.api.replay_settings import ReplayConfig
from osel_sim.api.results import MomentsResult, ReplayResult
from osel_sim.cli.command import Command

EXAMPLES = """examples:
  python -m osel_sim.replay assets/logs/pick_place                                   # every selector there is, 20 seeds
  python -m osel_sim.replay assets/logs/pick_place --selectors ppo ucb1 --preset waymo --out runs/ppo
  python -m osel_sim.replay assets/logs/suite --half score --selectors auto auto:warm   # without and with the outcomes of the other half beforehand
  python -m osel_sim.replay assets/logs/suite --selectors auto --budget-cents 5000   # what as much money buys, at best and by auto
  python -m osel_sim.replay logs/mine --alpha-time 0.1 --alpha-price 0.005 --seeds 5 --decisions 500 --no-frontier   # a quick look
  python -m osel_sim.replay assets/logs/suite --selectors linucb --robots 4 --share every:20   # what do four robots gain by sharing?
  python -m osel_sim.replay assets/logs/suite --selectors auto linucb --join remote_large@500 --leave remote_large@1200   # a policy comes and goes
  python -m osel_sim.replay assets/logs/suite --selectors auto --drift price:remote_large:x2@800 remote_large=local_small@1200   # dearer, then worse
  python -m osel_sim.replay assets/logs/moments                                      # when to hand over within an episode, and to whom
  python -m osel_sim.replay runs/pick_place-ppo-s0                                   # a live run: off-policy estimates from its propensities

Shows the log's instances in random orders without replacement to every selector, which sees only the outcome of its choice, and says how far each
stays from the oracles and whether routing is worth it. Fixed policies, the best and the worst of them, and the oracles are always included.
Instances on which some policy has no valid outcome are left out and counted. The result does not depend on --workers.
A log has no price lists: what policies cost, auto is told from the other half where --half is given, else from the log itself.
With --half a selector that learns off-policy can be shown all outcomes of the other half before its stream begins: auto:warm, linucb:warm ...

A verdict comes first, from auto, linucb and the fixed policies; then all other selectors are replayed, of which the paper's PPO takes longest, and
at last all of them at other weights of time and price, for the frontier (--no-frontier leaves that out). After each of the three what is known so far
is written, page included with --open: Ctrl-C loses no more than what is being replayed.

With --budget-cents selectors are replayed within that budget, too, and within quarters to four times of it: auto, unless --selectors names others.

Writes into --out: replay.json, choices.npz (every choice), selectors.csv, oracles.csv, paired.csv, frontier.csv. Of a live run's folder it estimates
what each fixed policy, random choice and a linear model would have earned (off_policy.json), and replays if the run has --counterfactual outcomes.
Likewise of a log of somebody's own decisions (ingest --propensity). Of a log with moments (record --moments) it compares monitors and start
selectors: moments.json, arms.csv, gains.csv (docs/moments.md)."""


def _execute(config: ReplayConfig) -> int:
    from osel_sim.api.replay import replay
    from osel_sim.cli.console import console
    from osel_sim.cli.moments_tables import print_moments
    from osel_sim.cli.next_step import print_next

    result = replay(config, on_result=_print)
    if isinstance(result, MomentsResult):
        print_moments(console(), result.result)
        print(f"written to {result.folder}")
        print_next(("makes a page of it", "report", [result.folder, "--open"]))
        return 0
    print(f"written to {result.folder}")
    if not config.open:
        page = result.folder if result.result is not None else config.log  # of estimates alone: the page is the run's, or the log's
        print_next(("makes a page of it", "report", [page, "--open"]))
    return 0


def _print(result: ReplayResult) -> None:
    """The verdict so far, while more is to come; in the end everything."""
    from osel_sim.cli.changes_tables import print_changes
    from osel_sim.cli.console import console
    from osel_sim.cli.replay_tables import print_off_policy, print_replay, print_so_far
    from osel_sim.cli.sharing_table import print_sharing
    from osel_sim.formats.replay_result import CHANGES, SHARING

    if result.result is not None and result.pending:
        print_so_far(console(), result.result)
        return
    if result.off_policy is not None:
        print_off_policy(console(), result.off_policy)
    if result.result is not None and CHANGES in result.result:
        print_changes(console(), result.result)
    elif result.result is not None:
        print_replay(console(), result.result)
        if SHARING in result.result:
            print_sharing(console(), result.result[SHARING])
    else:
        print("Only the outcomes of what was chosen are known, so selectors cannot be replayed (a live run has all with --counterfactual).")


main = Command("replay", ReplayConfig, _execute, EXAMPLES)

if __name__ == "__main__":
    sys.exit(main())
