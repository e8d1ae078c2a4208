"""Episodes in simulation with the weights of the moment."""

import dataclasses
from pathlib import Path

from osel_sim.core.errors import PolicyError
from osel_sim.formats.policy_file import PolicySpec


def success_rate(spec: PolicySpec, checkpoint: Path, task: str, episodes: int, seed: int, tasks: Path | None = None) -> float:
    """Share of validation instances solved by a checkpoint folder, driven as a local policy that answers at once.

    Args:
        task: the task whose validation instances are tried.
        seed: seed of the first instance; the others follow.
        tasks: folder with the user's own task files.

    Raises:
        PolicyError: an episode ended as an error, which is no failure of the policy.
    """
    from osel_sim.episodes.loop import Driver, run_episode
    from osel_sim.policy.local import LocalCaller
    from osel_sim.policy.registry import make_policy
    from osel_sim.suites.registry import find_task

    found = find_task(task, tasks)
    local = dataclasses.replace(spec, checkpoint=str(checkpoint.resolve()), remote=None, inference_seconds=0.0)
    driver = Driver(local, LocalCaller(make_policy(local, found.specification), local, found.specification))
    env = found.open()
    solved = 0
    try:
        for index in range(episodes):
            scene = found.instance(seed + index, 0, "validation")
            env.load(scene)
            outcome = run_episode(env, scene, driver)
            if outcome.error is not None:
                raise PolicyError(f"{scene.key}: {outcome.error}")
            solved += outcome.success
    finally:
        env.close()
    return solved / episodes
