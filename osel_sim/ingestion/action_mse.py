"""Minus the error of the actions that policies would have taken on the observations of a LeRobotDataset (paper, Open X-Embodiment).

Nothing is tried out: a policy is shown a logged frame and its instruction, and the actions it answers with are set against those logged from that
frame on. A remote policy pays for its call as in an episode: delays of the network model on the virtual clock, and its price. A call that fails
(deadline, outage) has no error to measure; nobody takes over.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from osel_sim.core.errors import UsageError, did_you_mean
from osel_sim.core.files import content_digest, file_digest
from osel_sim.episodes.loop import Driver, episode_seed
from osel_sim.formats.dataset_mapping import IMAGES, STATE, DatasetMapping
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.formats.rollout_log import Row
from osel_sim.ingestion.lerobot_check import open_dataset
from osel_sim.ingestion.lerobot_numbers import actions, check_mapping, states
from osel_sim.ingestion.write import IngestedInstance
from osel_sim.interface.encoder import Image
from osel_sim.interface.policy import Observation
from osel_sim.interface.specification import specification
from osel_sim.policy.history import History
from osel_sim.policy.mapping import turned_over


@dataclass(frozen=True)
class Measurement:
    """What is measured.

    Attributes:
        frames: of each episode, evenly spread from its first on.
        tolerance: success is an error of so much or less.
        cameras: camera of the policy files -> column of the dataset, where it is not the mapping's.
        mapping: the datasets' own names and conventions.
        file: where it was read, for errors.
    """

    frames: int = 4
    tolerance: float = 0.05
    cameras: Mapping[str, str] = field(default_factory=dict)
    mapping: DatasetMapping = field(default_factory=DatasetMapping)
    file: Path | None = None

    def column(self, camera: str) -> str:
        """The dataset's column of a camera."""
        return self.cameras.get(camera, self.mapping.camera(camera))


class Dataset:
    """A LeRobotDataset, checked against what the policies want to see.

    Raises:
        DataError: it is none, or lacks a camera, the state or the actions of the suite's form; names file, frame and column.
    """

    def __init__(self, folder: Path, cameras: Sequence[str], settings: Measurement) -> None:
        self.folder, self._settings, self._cameras = folder, settings, cameras
        self._files = open_dataset(folder)
        for camera in cameras:
            self._files.check_images(camera, settings.column(camera), f"--camera {camera}=COLUMN")
        self._states = states(self._files, settings.mapping)
        self.actions = actions(self._files, settings.mapping)

    def episodes(self) -> list[tuple[int, int]]:
        """First frame of each episode, and the one after its last."""
        return list(pairwise(self._files.starts.tolist()))

    def instruction(self, frame: int) -> str:
        """The task of a frame, in words."""
        return self._files.tasks[int(self._files.task[frame])]

    def observation(self, frame: int) -> Observation:
        """What the policies see of a frame."""
        pictures = zip(self._cameras, self.images(frame), strict=True)
        result: Observation = {IMAGES + camera: image for camera, image in pictures}
        return {**result, STATE: self._states[frame], "task": self.instruction(frame)}

    def images(self, frame: int) -> list[Image]:
        """The images of a frame."""
        flips = self._settings.mapping.flip
        return [turned_over(self._files.image(self._settings.column(camera), frame), flips.get(camera)) for camera in self._cameras]


@dataclass(frozen=True)
class Sample:
    """One logged frame.

    Attributes:
        start, frame, end: index of its episode's first frame, of the frame, and of the one after the episode's last.
    """

    instance: IngestedInstance
    dataset: Dataset
    frame: int
    end: int
    start: int

    def observations(self, count: int) -> list[Observation]:
        """What the policies see of the frame and of those before it, `count` at most, the newest last."""
        return [self.dataset.observation(frame) for frame in range(max(self.start, self.frame - count + 1), self.frame + 1)]


def open_datasets(folders: Sequence[Path], specs: Sequence[PolicySpec], settings: Measurement) -> list[Sample]:
    """The frames that policies are to be measured on: `settings.frames` of each episode of each dataset, whose images can all be read.

    Raises:
        DataError: a dataset is not as the policies want it.
        ContentError: the mapping does not fit.
        UsageError: two datasets have the same name.
    """
    cameras = sorted({camera for spec in specs for camera in spec.cameras})
    check_mapping(settings.mapping, settings.file, tuple(cameras))
    for camera in settings.cameras:
        if camera not in cameras:
            raise UsageError(f"--camera {camera}: no policy has that camera: {did_you_mean(camera, cameras)}cameras: {', '.join(cameras)}")
    names = [folder.resolve().name for folder in folders]
    samples = []
    for folder, name in zip(folders, names, strict=True):
        if names.count(name) > 1:
            raise UsageError(f"two datasets are called {name!r}, and the log needs a name for each")
        dataset = Dataset(folder, cameras, settings)
        digest = content_digest(*(file_digest(file) for file in sorted(folder.glob("data/**/*.parquet"))))
        for episode, (start, end) in enumerate(dataset.episodes()):
            chosen = np.unique(np.linspace(start, end, settings.frames, endpoint=False).astype(int))
            for frame in map(int, chosen):
                dataset.images(frame)  # a broken one is found before the policies are asked, not after
                key = f"{name}/{episode:06d}/{frame - start:06d}"
                instance = IngestedInstance(key, dataset.instruction(frame), digest, partial(dataset.images, frame))
                samples.append(Sample(instance, dataset, frame, end, start))
    return samples


def measure_errors(samples: Sequence[Sample], specs: Sequence[PolicySpec], settings: Measurement) -> tuple[list[Row], dict[str, Any]]:
    """Ask every policy for its actions on every sample.

    Returns:
        a row for each sample and policy, and what was measured, for the log's metadata.

    Raises:
        CheckpointError, RemoteError: a policy cannot be loaded or reached.
    """
    from osel_sim.core.progress import progress
    from osel_sim.episodes.drivers import Drivers

    rows = []
    with Drivers(specs, specification()) as drivers, progress(len(samples), "frame") as bar:
        for sample in samples:
            observations = sample.observations(max(spec.history for spec in specs))
            rows += [measure_one(sample, drivers[spec.name], observations, settings.tolerance) for spec in specs]
            bar.update()
    return rows, {
        "datasets": sorted({sample.dataset.folder.resolve().name for sample in samples}),
        "frames": settings.frames,
        "tolerance": settings.tolerance,
    }


def action_mse(actions: NDArray[np.float32], logged: NDArray[np.float32]) -> float:
    """Mean squared error of actions (T, D) over the steps that both have, float64 throughout."""
    steps = min(len(actions), len(logged))
    return float(np.mean(np.square(actions[:steps].astype(np.float64) - logged[:steps])))


def _shown(observation: Observation, spec: PolicySpec) -> Observation:
    """What one policy is shown of a frame."""
    pictures = {IMAGES + camera: _resized(observation[IMAGES + camera], spec.image_size) for camera in spec.cameras}
    return {**pictures, STATE: observation[STATE], "task": observation["task"]}


def measure_one(sample: Sample, driver: Driver, observations: Sequence[Observation], tolerance: float) -> Row:
    """Ask one policy for its actions on one sample; a call that fails and a policy that crashes are errors, not scores.

    Args:
        observations: of the frame and of those before it, the newest last; no fewer than the policy is shown, as far as the episode has them.
    """
    spec, key = driver.spec, sample.instance.key
    driver.caller.reset(sample.instance.text, episode_seed(key, spec.name, 0))
    history = History(spec.history)
    shown = [_shown(observation, spec) for observation in observations]
    for earlier in shown[:-1]:
        history.remember(earlier)
    seen = history.with_present(shown[-1])
    error: str | None = None
    score: float | None = None
    actions = 0
    try:
        call = driver.caller.call(seen)
    except Exception as problem:  # a crash is never a policy's failure
        upload = inference = download = megabytes = 0.0
        error = f"{spec.name}: {type(problem).__name__}: {' '.join(str(problem).split())}"
    else:
        upload, inference, download, megabytes = call.upload, call.inference, call.download, call.megabytes
        if call.actions is None:
            error = f"{spec.name}: {call.failure}"
        else:
            # What would be executed before the next call, as far as the episode goes on.
            logged = sample.dataset.actions[sample.frame : min(sample.frame + spec.execute, sample.end)]
            actions = min(len(call.actions), len(logged))
            score = -action_mse(call.actions, logged)
    return Row(
        task=key.partition("/")[0],
        instance=key,
        seed=None,
        level=None,
        split=None,
        instruction=sample.instance.text,
        phrasing=None,
        target=None,
        container=None,
        policy=spec.name,
        repeat=0,
        success=score is not None and -score <= tolerance,
        subgoals=None,
        steps=None,
        upload=upload,
        inference=inference,
        download=download,
        motion=None,
        calls=1,
        actions=actions,
        price=spec.price.of(actions, 1, megabytes),
        fallback=None,
        error=error,
        score=score,
    )


def _resized(image: Image, side: int) -> Image:
    """The square image that a policy file asks for; one of other proportions is stretched."""
    import cv2

    if image.shape[:2] == (side, side):
        return image
    shrinks = min(image.shape[:2]) >= side
    return np.asarray(cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), np.uint8)
