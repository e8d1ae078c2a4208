"""The settings of a recording."""

from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Le

from osel_sim.api.settings import INSTANCES, MAIN, ContentSettings, Count, Folder, Group, Index, InstanceSettings, Names, settings

STOPPING = Group("Stopping early", 0.5)
HANDOFFS = Group("Handing over within an episode", 0.4)
CLUSTER = Group("On several machines", 0.7)


@settings
class RecordConfig(InstanceSettings, ContentSettings):
    """Run every policy on the same instances and write the outcomes to a rollout log."""

    task: Annotated[Names, MAIN] = ()
    """which tasks: names, tag:TAG, or all; of other suites SUITE:NAME"""
    policies: Annotated[Names | None, MAIN] = None
    """policies to run (default: all that fit the tasks)"""
    instances: Annotated[Count, MAIN] = 200
    """number of instances of each task"""
    repeats: Annotated[Count | None, MAIN] = None
    """episodes of each policy on an instance (default: 1)"""
    repeat_every: Annotated[Count | None, MAIN] = None
    """repeat on one in so many instances of each level only (default: on all)"""
    encoder: Annotated[str | None, MAIN] = None
    """osel_small (default), osel_suite, MODEL:TAG of open_clip such as ViT-L-14:openai, MODEL:FILE, or a folder"""
    out: Annotated[Path | None, MAIN] = None
    """where to write"""
    resume: Annotated[bool, MAIN] = False
    """go on with the recording in --out, or add policies, repeats or an encoder's contexts to it"""
    workers: Annotated[Count, MAIN] = 2
    """processes; the result does not depend on how many"""
    until_decided: Annotated[bool, STOPPING] = False
    """stop as soon as every two policies are told apart, or the second is no worse than the first by --margin"""
    margin: Annotated[float, Ge(0.0), Le(0.99), STOPPING] = 0.05
    """with --until-decided: how much lower success may be to count as no worse; 0.05 is 5 points, 0 asks which is better"""
    baseline: Annotated[Folder | None, STOPPING] = None
    """with --until-decided: log to compare with; without --task, its instances are taken"""
    baseline_policy: Annotated[str | None, STOPPING] = None
    """policy of --baseline, where that has several (default: the one that is recorded)"""
    moments: Annotated[Count | None, HANDOFFS] = None
    """cut every episode before every so many calls, and let every other policy drive on from there: moments.parquet, for replay (docs/moments.md)"""
    most_moments: Annotated[Count | None, HANDOFFS] = None
    """with --moments: cut an episode so many times at most (default: until it is over)"""
    start_seed: Annotated[Index, INSTANCES] = 0
    """seed of the first instance"""
    shard: Annotated[str | None, CLUSTER] = None
    """NUMBER/ALL, such as 3/40: record the third of forty parts only; osel_sim.merge puts them together"""
    cluster: Annotated[Literal["slurm", "ray", "local"] | None, CLUSTER] = None
    """record the parts elsewhere, and put them together: on a Slurm or Ray cluster, or as processes of this machine"""
    shards: Annotated[Count | None, CLUSTER] = None
    """with --cluster: number of parts"""
    retries: Annotated[Index, CLUSTER] = 2
    """with --cluster: how often a part that failed is sent again"""
    at_once: Annotated[Count | None, CLUSTER] = None
    """with --cluster: at most so many parts at a time (default: as many as the cluster takes, and as this machine has cores for)"""
    cluster_option: Annotated[Names, CLUSTER] = ()
    """with --cluster: KEY=VALUE for each part, as submitit (slurm_partition=gpu) or Ray (num_gpus=0.5) has it; repeatable"""
