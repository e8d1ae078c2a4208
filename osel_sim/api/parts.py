"""The parts alone: a log, an environment, a policy, a selector."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from osel_sim.analysis.log import LoggedOutcomes
    from osel_sim.interface.policy import Policy
    from osel_sim.interface.selector import Selector
    from osel_sim.sim.env import TaskEnv


def load_log(folder: Path | str, encoder: str | None = None) -> "LoggedOutcomes":
    """Read a rollout log with its contexts.

    Args:
        folder: with `rollouts.parquet` and `contexts.npz`.
        encoder: whose contexts, where it has several; None: the one it was recorded with.

    Raises:
        DataError: no log there, or it is damaged; names what is wrong.
    """
    from osel_sim.analysis.log import read_log

    return read_log(Path(folder), encoder)


def make_env(task: str, *, tasks: Path | str | None = None, **options: Any) -> "TaskEnv":
    """Make a task's environment, a `gymnasium.Env`.

    Args:
        task: name of a task file. Environments of other suites: `osel_sim.suites.registry.find_task(name).open()`.
        tasks: folder with task files of your own.
        options: split, level, axes, cameras, image_size, render_mode, robot, as `osel_sim.sim.env.TaskEnv` takes them.

    Raises:
        UnknownNameError: no such task; names the nearest.
    """
    from osel_sim.sim.env import TaskEnv
    from osel_sim.suites.registry import select_task_files

    return TaskEnv(select_task_files([task], None if tasks is None else Path(tasks))[0], **options)


def load_policy(name: str, *, task: str | None = None, policies_dir: Path | str | None = None) -> "Policy":
    """Load a local policy, weights included, to be asked for actions: `reset(instruction)`, then `act(observation)`.

    Args:
        name: of a policy file. Of a remote one the checkpoint is loaded here, without server, network or price.
        task: that it will drive in; None: any of our own.
        policies_dir: folder with policy files of your own.

    Raises:
        UnknownNameError: no such policy or task; names the nearest.
        ContentError: the policy's file does not fit the task's environment.
        CheckpointError: its checkpoint is missing, unreadable or does not fit its file.
    """
    from osel_sim.formats import library
    from osel_sim.interface.specification import specification
    from osel_sim.policy.registry import make_policy
    from osel_sim.suites.registry import find_task

    environment = specification() if task is None else find_task(task).specification
    return make_policy(library.load_policy(name, None if policies_dir is None else Path(policies_dir)), environment)


def make_selector(name: str, policies: Sequence[str], context_dim: int, seed: int = 0, **settings: Any) -> "Selector":
    """Make a selector.

    Args:
        name: such as `auto`, `ppo`, `thompson`, `fixed:POLICY`.
        policies: names to choose from.
        context_dim: length of a context.
        seed: of everything random in it.
        settings: its hyper-parameters by name.

    Raises:
        UnknownNameError: no such selector or setting; names the nearest.
    """
    from osel_sim.selection import registry

    return registry.make_selector(name, policies, context_dim, seed, **settings)
