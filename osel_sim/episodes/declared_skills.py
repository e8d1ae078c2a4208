"""The skills that policies declare, and what instructions that ask for them look like to an encoder."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from osel_sim.core import content
from osel_sim.core.errors import ContentError, DataError, UsageError
from osel_sim.core.files import read_json
from osel_sim.core.torch_settings import threads
from osel_sim.formats.merged_policy import MERGE, parts_of
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.encoder import Encoder
from osel_sim.interface.suite import Task
from osel_sim.selection.skills import Skills
from osel_sim.suites.registry import select_tasks

TRAINING = "training.json"
EXAMPLES = 8
"""Instructions a skill. More told tasks apart no better (osel_suite, 3,300 test instances: 91% with 8, 90% with 48)."""


def declared_skills(spec: PolicySpec, tasks: Path | None = None) -> tuple[str, ...] | None:
    """Names of the tasks that a policy was made for; None if nobody says.

    A merge was made for what any of its parts was made for, where all of them say.

    Said by `skills` in its file, else by the `training.json` that osel_sim.train leaves beside a checkpoint: the tasks of its demonstrations, as far
    as there are files of them.

    Args:
        tasks: folder with the user's own task files.

    Raises:
        ContentError: the file names a task that there is not.
    """
    if spec.kind == MERGE:
        known_of = [declared_skills(part, tasks) for part in parts_of(spec)]
        return None if None in known_of else tuple(dict.fromkeys(name for names in known_of for name in names or ()))
    if spec.skills is not None:
        try:
            return tuple(task.name for task in select_tasks(spec.skills, tasks))
        except UsageError as error:  # no such suite, or a package of it is missing
            raise ContentError(spec.file, "skills", str(error)) from None
    checkpoint = content.resolve_checkpoint(spec.checkpoint) if spec.checkpoint else None
    if not isinstance(checkpoint, Path):
        return None
    try:
        trained = [dataset["task"] for dataset in read_json(checkpoint / TRAINING)["datasets"]]
    except (DataError, KeyError, TypeError):
        return None
    known = content.files("tasks", tasks)
    return tuple(dict.fromkeys(name for name in trained if isinstance(name, str) and name in known)) or None


def declare(policies: Sequence[PolicySpec], encoder: Encoder, asked: Sequence[Task], tasks: Path | None = None) -> Skills | None:
    """What policies declare, with examples in an encoder's eyes; None if none of them declares anything.

    Examples are clean instructions of the train split (the first split of a suite that has none) with a blank image: of what is declared, and of
    what will be asked, lest a task that nobody declares be taken for the nearest that somebody does.

    Args:
        asked: tasks that will be asked for.
        tasks: folder with the user's own task files.

    Raises:
        ContentError: a policy's file names a task that there is not.
    """
    declared = {spec.name: declared_skills(spec, tasks) for spec in policies}
    able = {policy: names for policy, names in declared.items() if names is not None}
    if not able:
        return None
    wanted = {task.name: task for task in [*select_tasks(sorted({name for own in able.values() for name in own}), tasks), *asked]}
    blank = np.zeros((encoder.image_size, encoder.image_size, 3), np.uint8)
    examples = {}
    with threads(1):
        for name, task in sorted(wanted.items()):
            suite = task.suite.spec
            split = "train" if "train" in suite.splits else suite.splits[0]
            texts = [task.instance(seed, suite.levels[0], split).instruction for seed in range(EXAMPLES)]
            examples[name] = np.stack([encoder.encode([blank], text) for text in texts])
    return Skills(examples, able)
