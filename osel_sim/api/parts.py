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
        task: name of a task file.
        tasks: folder with task files of your own.
        options: split, level, axes, cameras, image_size, render_mode, as `osel_sim.sim.env.TaskEnv` takes them.

    Raises:
        UnknownNameError: no such task; names the nearest.
    """
    from osel_sim.formats.library import select_tasks
    from osel_sim.sim.env import TaskEnv

    return TaskEnv(select_tasks([task], None if tasks is None else Path(tasks))[0], **options)


def load_policy(name: str, *, policies_dir: Path | str | None = None) -> "Policy":
    """Load a local policy, weights included, to be asked for actions: `reset(instruction)`, then `act(observation)`.

    Args:
        name: of a policy file. Of a remote one the checkpoint is loaded here, without server, network or price.
        policies_dir: folder with policy files of your own.

    Raises:
        UnknownNameError: no such policy; names the nearest.
        CheckpointError: its checkpoint is missing, unreadable or does not fit its file.
    """
    from osel_sim.formats import library
    from osel_sim.policy.registry import make_policy

    return make_policy(library.load_policy(name, None if policies_dir is None else Path(policies_dir)))


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
