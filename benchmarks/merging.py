"""Where does asking two policies at once, and merging their chunks, beat the better of the two?

    python benchmarks/merging.py record --out runs/merging --seeds 30     # merges on the choosing half of the suite's instances; goes on where it was
    python benchmarks/merging.py table --out runs/merging                 # against the policies themselves, whose outcomes assets/logs/suite holds

The instances, the noise on actions and the policies are those of `assets/logs/suite` (first repeat), so that every comparison is within instances.
"""

import argparse
from contextlib import closing
from pathlib import Path

import numpy as np

from osel_sim.analysis.log import read_log
from osel_sim.core.content import root
from osel_sim.core.progress import progress
from osel_sim.formats.merged_policy import part_names
from osel_sim.formats.shards import Shards
from osel_sim.interface.outcome import credited
from osel_sim.selection.reward import PRESETS, row_rewards
from osel_sim.statistics.intervals import bootstrap_mean_interval

LOG = root() / "assets" / "logs" / "suite"
MERGES = ("merge:local_small+remote_large", "merge:remote_large+remote_base")
BLOCK = 10
"""Seeds of each task that are recorded before the next task's, so that any beginning of the recording has all tasks."""


def record(out: Path, seeds: int, workers: int) -> None:
    """Record the merges on those of the first seeds' instances that are in the choosing half."""
    from osel_sim.context.encoder import load_encoder
    from osel_sim.episodes.drivers import choose_policies, with_fallbacks
    from osel_sim.episodes.recording import Recording
    from osel_sim.episodes.workers import Plan
    from osel_sim.episodes.workers import record as record_episodes
    from osel_sim.suites.registry import common_specification, select_tasks

    log = read_log(LOG)
    began = log.metadata
    tasks = select_tasks(began["tasks"], None, None)
    policies = choose_policies(MERGES, common_specification(tasks))
    plan = Plan(
        tasks=tuple(tasks),
        policies=tuple(policies),
        everyone=tuple(with_fallbacks(policies)),
        seeds=range(seeds),
        levels=tuple(began["levels"]),
        split=began["split"],
        encoder="osel_small",
        action_noise=began["action_noise"],
    )
    out.mkdir(parents=True, exist_ok=True)
    choosing = {instance.key for instance in log.instances if instance.half == "choose"}
    recording = Recording(out, plan, load_encoder(plan.encoder).identity)
    recording.keep_to(choosing & plan.instances.keys())
    missing = recording.missing()
    order = sorted(missing, key=lambda key: (plan.instances[key].seed // BLOCK, plan.instances[key].task, plan.instances[key].seed))
    with (
        progress(sum(map(len, missing.values())), "episode") as bar,
        closing(record_episodes(plan, {key: missing[key] for key in order}, workers, bar.begin)) as events,
    ):
        for recorded in events:
            if recorded is None:
                bar.update()
            else:
                recording.add(recorded)


def table(out: Path) -> None:
    """Print in Markdown what each merge came to on the instances that were recorded, against its parts on the very same."""
    log = read_log(LOG)
    weights = PRESETS["oxe"]
    recorded = [row for rows in Shards(out).rows.values() for row in rows.values() if row.error is None]
    at = {instance.key: number for number, instance in enumerate(log.instances)}
    rewards = log.rewards(weights)[:, :, 0]
    print("| merge | episodes | its success | better part | its success | reward | reward of the better part | difference [95%] | cents |")
    print("|---|---:|---:|---|---:|---:|---:|---:|---:|")
    for merge in MERGES:
        for task in (None, *sorted({row.task for row in recorded})):
            rows = [row for row in recorded if row.policy == merge and task in (None, row.task)]
            index = np.array([at[row.instance] for row in rows], np.int64)
            columns = [log.policies.index(part) for part in part_names(merge)]
            known = np.isfinite(rewards[np.ix_(index, columns)]).all(axis=1) if rows else np.zeros(0, bool)
            if not known.any():
                continue
            rows, index = [row for row, use in zip(rows, known, strict=True) if use], index[known]
            own = row_rewards(rows, weights)
            better = max(columns, key=lambda column: float(rewards[index, column].mean()))
            apart = own - rewards[index, better]
            low, high = bootstrap_mean_interval(apart)
            cells = (
                merge if task is None else f"· {task}",
                f"{len(rows)}",
                f"{100 * np.mean([credited(row, 'success') for row in rows]):.0f}%",
                log.policies[better],
                f"{100 * log.success[index, better, 0].mean():.0f}%",
                f"{own.mean():.3f}",
                f"{rewards[index, better].mean():.3f}",
                f"{apart.mean():+.3f} [{low:+.3f}, {high:+.3f}]",
                f"{np.mean([row.price for row in rows]):.1f}",
            )
            print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "table"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.what == "record":
        record(arguments.out, arguments.seeds, arguments.workers)
    else:
        table(arguments.out)
