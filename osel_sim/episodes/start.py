"""The beginning of an instance, gone back to for every policy that runs on it."""

from osel_sim.interface.environment import Environment, TellsScene
from osel_sim.interface.instance import Instance


class Start:
    """An instance loaded into an environment; `again` goes back to its beginning by a snapshot, or where there is none by loading it once more.

    Attributes:
        scene: digest of its scene; None where the environment does not tell.
    """

    def __init__(self, env: Environment, instance: Instance) -> None:
        env.load(instance)
        self._env, self._instance = env, instance
        self.scene = (env.scene_digest() or None) if isinstance(env, TellsScene) else None
        self._snapshot = env.snapshot() if env.specification.snapshots else None

    def again(self) -> None:
        """Back to the beginning."""
        if self._env.specification.snapshots:
            self._env.restore(self._snapshot)
        else:
            self._env.load(self._instance)
