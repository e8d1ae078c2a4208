"""Several policies asked at once, and one chunk of actions made of their answers.

Where they agree the mean is taken: their errors are their own and cancel out in part. Where they do not, a mean may be what neither meant (left and
right of an obstacle comes to straight into it), and the trusted one is followed. Chunks that overlap have long been averaged like that, of one policy
(ACT's temporal ensembling, Zhao et al. 2023) and of several (ensembles of imitators, e.g. Menda et al. 2019, EnsembleDAgger, which also hands over
by their disagreement).
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from osel_sim.episodes.driver import Driver
from osel_sim.formats.merged_policy import MergedSpec
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.call import Call, Privileged
from osel_sim.interface.environment import ActionSpec, Environment
from osel_sim.interface.policy import Actions, Observation
from osel_sim.policy.history import split, stacked

AGREEMENT = 0.5
"""Two policies agree on a control step where no motion of theirs differs by more than this share of half the motion's range."""


def merge_chunks(chunks: Sequence[Actions], action: ActionSpec) -> Actions:
    """One chunk of several, control step by control step.

    The motions are the mean over the first chunk and those that agree with it in that step (`AGREEMENT`); the gripper is always the first one's, as
    half closed is neither.

    Args:
        chunks: (T_i, D) each, of lengths that may differ, the trusted one first.

    Returns:
        (T, D), T being the least of the lengths.
    """
    length = min(map(len, chunks))
    stack: NDArray[np.float64] = np.stack([chunk[:length] for chunk in chunks]).astype(np.float64)
    motions = action.motions
    apart = np.abs(stack - stack[0])[:, :, motions] / action.half_range[motions]
    agrees = (apart <= AGREEMENT).all(axis=2).astype(np.float64)  # (policies, T); with no motion at all, all agree
    result = stack[0].copy()
    result[:, motions] = (np.einsum("pt,ptd->td", agrees, stack) / agrees.sum(axis=0)[:, None])[:, motions]
    return np.asarray(result, np.float32)


class MergedCaller:
    """Asks all of its policies and merges what they answer; a `Caller`.

    All are asked at the same moment and the slowest is waited for: the call's seconds are its. Everyone who was asked is paid, and for an action
    everyone who had a part in the answer. Where one fails the others' answers are used, and it is not asked again in this episode (alone it would
    have been given up for good as well); where all have failed the call has.

    Args:
        spec: of the merge.
        drivers: of its parts, in their order. They stay their owner's, who closes them.
        action: what their actions hold.
    """

    def __init__(self, spec: MergedSpec, drivers: Sequence[Driver], action: ActionSpec) -> None:
        self._spec, self._drivers, self._action = spec, list(drivers), action
        self._order = list(range(len(self._drivers)))  # the trusted one first
        self._failures: dict[int, str] = {}
        self._env: Environment | None = None

    def trust(self, propensities: Mapping[str, float]) -> None:
        """Trust its parts in the order of the probabilities with which a selector would have chosen each; of equals the one named first.

        Args:
            propensities: policy -> probability; those that are no choice of the selector count as 0.
        """
        self._order = sorted(range(len(self._drivers)), key=lambda index: -propensities.get(self._drivers[index].spec.name, 0.0))

    def bind(self, env: Environment) -> None:
        """Remember the world: its parts may want images of different sizes, and may be privileged themselves."""
        self._env = env
        for driver in self._drivers:
            if isinstance(driver.caller, Privileged):
                driver.caller.bind(env)

    def reset(self, instruction: str, seed: tuple[int, ...]) -> None:
        """Start a new episode with all of them; each has its own chance."""
        self._failures = {}
        for index, driver in enumerate(self._drivers):
            driver.caller.reset(instruction, (*seed, index))

    def call(self, observation: Observation) -> Call:
        """What they come to together, or why none of them has an answer."""
        asked = [index for index in range(len(self._drivers)) if index not in self._failures]
        calls = {index: self._drivers[index].caller.call(self._seen(observation, self._drivers[index].spec)) for index in asked}
        self._failures |= {index: call.failure for index, call in calls.items() if call.failure is not None}
        answers = {index: actions for index in self._order if index in calls and (actions := calls[index].actions) is not None}
        slowest = max(calls.values(), key=lambda call: call.seconds)
        told = "; ".join(f"{self._drivers[index].spec.name}: {failure}" for index, failure in sorted(self._failures.items()))
        prices = {index: self._drivers[index].spec.price for index in calls}
        return Call(
            merge_chunks(list(answers.values()), self._action) if answers else None,
            slowest.upload,
            slowest.inference,
            slowest.download,
            sum(call.megabytes for call in calls.values()),
            sum(call.measured_seconds for call in calls.values()),
            None if answers else told,
            any(call.sent for call in calls.values()),
            paid=sum(prices[index].of(0, int(call.sent), call.megabytes) for index, call in calls.items()),
            paid_per_action=sum(prices[index].per_action for index in answers),
        )

    def close(self) -> None:
        """The parts are closed by their owner."""

    def _seen(self, observation: Observation, part: PolicySpec) -> Observation:
        """What a part is shown, of what the merge is shown: its cameras, as many successive ones as it wants, and its own size of images."""
        if part.image_size != self._spec.image_size and self._env is not None:
            return self._env.observe(part.cameras, part.image_size)  # its history is 1: `merged` saw to it
        images = {f"observation.images.{camera}" for camera in part.cameras}
        seen = {key: value for key, value in observation.items() if key in images or not key.startswith("observation.images.")}
        if part.history == self._spec.history:
            return seen
        last = split(seen)[-part.history :]
        return stacked(last) if part.history > 1 else last[0]
