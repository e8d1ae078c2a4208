"""The scripted expert as a policy: the ceiling that policies which only see can be compared with."""

import time
from typing import TYPE_CHECKING, Any

from osel_sim.core.errors import PolicyError
from osel_sim.formats.policy_file import PolicySpec
from osel_sim.interface.call import Call
from osel_sim.interface.policy import Observation

if TYPE_CHECKING:
    from osel_sim.sim.env import TaskEnv


class ExpertCaller:
    """Asks the task's scripted expert for one action after the other; a `Caller` that is `Privileged`."""

    def __init__(self, spec: PolicySpec) -> None:
        self._spec = spec
        self._env: TaskEnv | None = None
        self._expert: Any = None

    def bind(self, env: "TaskEnv") -> None:
        """Remember whose world to look at."""
        self._env = env

    def reset(self, instruction: str, seed: tuple[int, ...]) -> None:
        """Begin the plan anew; the instance says what is meant, the instruction is not read."""
        from osel_sim.sim.expert import Expert

        if self._env is None:
            raise PolicyError(f"{self._spec.name}: the scripted expert was not shown the world it acts in")
        self._expert = Expert(self._env.world)

    def call(self, observation: Observation) -> Call:
        """The next action, as a chunk of one."""
        start = time.perf_counter()
        action = self._expert.act()
        return Call(action[None], inference=self._spec.inference_seconds, measured_seconds=time.perf_counter() - start)

    def close(self) -> None:
        """Forget the world."""
        self._env = self._expert = None
