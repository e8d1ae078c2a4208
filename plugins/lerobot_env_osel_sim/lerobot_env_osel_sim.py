"""What LeRobot imports to know `--env.type=osel_sim` and the policy types of osel_sim."""

from osel_sim.policy import register
from osel_sim.suites.lerobot_env import OselSimEnv

register()

__all__ = ["OselSimEnv"]
