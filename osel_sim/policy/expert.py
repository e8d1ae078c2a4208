"""The scripted expert as a policy: the ceiling that policies which only see can be compared with."""

import time

import numpy as np

from osel_sim.core.errors import PolicyError
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.call import Call
from osel_sim.interface.environment import Environment, Expert, HasExpert
from osel_sim.interface.policy import Observation


class ExpertCaller:
    """Asks the environment's scripted expert for one action after the other; a `Caller` that is `Privileged`."""

    def __init__(self, spec: PolicySpec) -> None:
        self._spec = spec
        self._env: Environment | None = None
        self._expert: Expert | None = None

    def bind(self, env: Environment) -> None:
        """Remember whose world to look at."""
        self._env = env

    def reset(self, instruction: str, seed: tuple[int, ...]) -> None:
        """Begin the plan anew; the instance says what is meant, the instruction is not read."""
        if self._env is None:
            raise PolicyError(f"{self._spec.name}: the scripted expert was not shown the world it acts in")
        if not isinstance(self._env, HasExpert):
            raise PolicyError(f"{self._spec.name}: the environment of {self._env.specification.name} has no scripted expert")
        self._expert = self._env.expert()

    def call(self, observation: Observation) -> Call:
        """The next action, as a chunk of one."""
        if self._expert is None:
            raise PolicyError(f"{self._spec.name}: no episode was started")
        start = time.perf_counter()
        action = self._expert.act()
        return Call(np.asarray(action)[None], inference=self._spec.inference_seconds, measured_seconds=time.perf_counter() - start)

    def close(self) -> None:
        """Forget the world."""
        self._env = self._expert = None
