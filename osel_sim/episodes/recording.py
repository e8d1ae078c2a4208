"""A recording in its folder: what is there of a plan, what is missing, and how it becomes a rollout log."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from osel_sim.context.cache import ContextCache
from osel_sim.core.errors import DataError
from osel_sim.episodes.moment_recording import MomentRecording
from osel_sim.episodes.workers import Episode, Plan, Recorded, worker_died
from osel_sim.formats.rollout_log import DECLARED, ROLLOUTS, Row, read_rollouts, write_rollouts
from osel_sim.formats.shards import SHARDS, Shards
from osel_sim.selection.skills import Skills


class Recording:
    """What a folder holds of a plan: in its rollout log and contexts if it has those already, and in the shards beside them.

    Episodes that were lost because their worker died count as not there.

    Args:
        encoder: identity of the one whose contexts are wanted.
        skills: what the policies declare; kept with the log.

    Attributes:
        grew: something was added.
    """

    def __init__(self, folder: Path, plan: Plan, encoder: str, skills: Skills | None = None) -> None:
        self.folder, self.plan, self.encoder, self.grew = folder, plan, encoder, False
        self._skills = skills
        self._instances: tuple[str, ...] = tuple(plan.instances)
        self._cache = ContextCache(folder, autosave=0, mend=True)
        self._rows: dict[str, dict[Episode, Row]] = {}
        self._scenes: dict[str, str] = {}
        there, metadata = read_rollouts(folder) if (folder / ROLLOUTS).exists() else ([], {})
        self._declared, self._default = metadata.get(DECLARED), metadata.get("encoder")
        self._shards = Shards(folder) if (folder / SHARDS).exists() else None
        self._moments = MomentRecording(folder) if plan.cuts is not None else None
        in_shards = [row for rows in self._shards.rows.values() for row in rows.values()] if self._shards is not None else []
        for row in [*there, *in_shards]:
            if row.scene is not None:
                self._scenes.setdefault(row.instance, row.scene)
            if not worker_died(row):
                self._rows.setdefault(row.instance, {})[row.policy, row.repeat] = row

    @property
    def rows(self) -> Mapping[str, Mapping[Episode, Row]]:
        """Instance -> its episodes that are there."""
        return self._rows

    def keep_to(self, instances: Collection[str]) -> None:
        """Want no more than these instances of the plan; what is there of others does not go into the log."""
        self._instances = tuple(key for key in self.plan.instances if key in instances)

    @property
    def lost(self) -> list[Row]:
        """Episodes that were lost, and lost again if they were there before, because their worker died."""
        return [row for key in self._instances for row in self._rows.get(key, {}).values() if worker_died(row)]

    @property
    def complete(self) -> bool:
        """The rollout log and its contexts hold everything, and the contexts it is read with are this encoder's."""
        return self._shards is None and self._default == self.encoder and not self.missing() and self._has_skills()

    def missing(self) -> dict[str, list[Episode]]:
        """Episodes that are not there, by instance; an instance that lacks only its context has none."""
        result = {}
        for instance in self._instances:
            there = self._rows.get(instance, {})
            episodes = [episode for episode in self.plan.episodes(instance) if episode not in there]
            if episodes or not self._has_context(instance):
                result[instance] = episodes
        return result

    def add(self, recorded: Recorded) -> list[Row]:
        """Take in an instance, and wait until it is on disk. Returns its new rows in the plan's order.

        Raises:
            DataError: its scene is another one than that of the episodes which are there.
        """
        rows = [recorded.rows[episode] for episode in self.plan.episodes(recorded.instance) if episode in recorded.rows]
        for row in rows:
            if row.scene is not None and row.scene != self._scenes.setdefault(row.instance, row.scene):
                raise DataError(
                    f"{self.folder}: instance {row.instance!r} now has another scene than in the episodes that are there: "
                    "assets, suite or versions have changed since. Record all policies anew in another folder"
                )
        if self._shards is None:
            self._shards = Shards(self.folder)
        if self._moments is not None:
            self._moments.add({(recorded.instance, *episode): moments for episode, moments in recorded.moments.items()})
        self._shards.add(recorded.instance, rows, self.encoder, recorded.context)
        self._rows.setdefault(recorded.instance, {}).update(recorded.rows)
        self.grew = True
        return rows

    def finish(self, configuration: dict[str, Any]) -> None:
        """Turn what is there into the rollout log and its contexts.

        Args:
            configuration: goes into the log's metadata.
        """
        shards = self._shards or Shards(self.folder)
        for encoder, contexts in shards.contexts.items():
            for instance in self._instances:
                if instance in contexts:
                    self._cache.put(encoder, instance, contexts[instance])
        if self._skills is not None:
            for skill, examples in self._skills.examples.items():
                self._cache.put_examples(self.encoder, skill, list(examples))
            configuration = configuration | {DECLARED: self._able}
        self._cache.save()
        if self._moments is not None and self.plan.cuts is not None:
            episodes = [(key, *episode) for key in self._instances for episode in self.plan.episodes(key)]
            self._moments.finish(episodes, self.plan.cuts, self._about_moments)
        write_rollouts(self.folder, [self._rows[key][episode] for key in self._instances for episode in self.plan.episodes(key)], configuration)
        shards.close(remove=True)
        self._shards = None

    @property
    def _about_moments(self) -> dict[str, Any]:
        policies = self.plan.policies
        return {
            "policies": [spec.name for spec in policies],
            "remote": [spec.name for spec in policies if spec.is_remote],
            "encoder": self.encoder,
        }

    @property
    def _able(self) -> dict[str, list[str]] | None:
        """What is declared, as it lies in the log's metadata."""
        return None if self._skills is None else {policy: list(names) for policy, names in self._skills.able.items()}

    def _has_skills(self) -> bool:
        there = self._cache.skills(self.encoder)
        return self._declared == self._able and (self._skills is None or set(self._skills.examples) <= set(there))

    def _has_context(self, instance: str) -> bool:
        in_shards = self._shards is not None and instance in self._shards.contexts.get(self.encoder, {})
        return in_shards or self._cache.get(self.encoder, instance) is not None
