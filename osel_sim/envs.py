"""Names for `gymnasium.make`: importing this registers `osel_sim/<task>-v0` for every shipped task. Nothing heavy is imported until one is made.

import gymnasium
env = gymnasium.make("osel_sim.envs:osel_sim/pick_place-v0", cameras=("agentview",))      # gymnasium imports the module itself
"""

import gymnasium

from osel_sim.core import content


def register_envs() -> None:
    """Register every shipped task that is not registered yet."""
    for name in content.files("tasks"):
        if f"osel_sim/{name}-v0" not in gymnasium.registry:
            gymnasium.register(id=f"osel_sim/{name}-v0", entry_point="osel_sim.sim.env:TaskEnv", kwargs={"task": name})


register_envs()
