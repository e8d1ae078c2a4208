"""Rollout logs with known success rates: clusters in the contexts, each with its own rate for every policy."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from osel_sim.context.cache import ContextCache
from osel_sim.formats.rollout_log import Row, write_rollouts


@dataclass(frozen=True)
class Synthetic:
    """What was written, and the truth behind it.

    Attributes:
        cluster: (instances,) of each.
        rates: (clusters, policies) success rates.
    """

    folder: Path
    policies: tuple[str, ...]
    contexts: np.ndarray
    cluster: np.ndarray
    rates: np.ndarray

    @property
    def best_single(self) -> float:
        return float(self.rates[self.cluster].mean(axis=0).max())

    @property
    def oracle(self) -> float:
        return float(self.rates[self.cluster].max(axis=1).mean())


def make_row(instance: str, policy: str, repeat: int = 0, success: bool = True, **values) -> Row:
    """A row of a log; what is not given is plain."""
    plain = {"task": "made_up", "seed": None, "level": 0, "split": "test", "instruction": "do it", "phrasing": "p-0", "target": "", "container": ""}
    plain |= {"subgoals": float(success), "steps": 20, "upload": 0.0, "inference": 0.0, "download": 0.0, "motion": 1.0, "calls": 1, "actions": 20}
    plain |= {"price": 0.0, "fallback": None, "error": None}
    return Row(**{**plain, "instance": instance, "policy": policy, "repeat": repeat, "success": success, **values})


def write_log(folder: Path, rows: list[Row], contexts: dict[str, np.ndarray], encoder: str = "made_up@1") -> Path:
    """A rollout log with its contexts."""
    folder.mkdir(parents=True, exist_ok=True)
    cache = ContextCache(folder, autosave=0)
    for key, context in contexts.items():
        cache.put(encoder, key, np.asarray(context, np.float32))
    cache.save()
    write_rollouts(folder, rows, {"encoder": encoder})
    return folder


def clusters(
    folder: Path, instances: int = 2000, clusters: int = 30, dim: int = 512, policies: int = 4, repeats: int = 1, seed: int = 0, spread: float = 0.02
) -> Synthetic:
    """The stream of binary outcomes that selectors are tried on: unit-length contexts around `clusters` centres, uniform success rates."""
    generator = np.random.default_rng(seed)
    centres = generator.normal(size=(clusters, dim)) / np.sqrt(dim)
    rates = generator.uniform(0.05, 0.95, size=(clusters, policies))
    cluster = generator.integers(clusters, size=instances)
    contexts = centres[cluster] + spread * generator.normal(size=(instances, dim))
    contexts = (contexts / np.linalg.norm(contexts, axis=1, keepdims=True)).astype(np.float32)
    names = tuple(f"policy_{index}" for index in range(policies))
    outcomes = generator.random((instances, policies, repeats)) < rates[cluster][:, :, None]
    rows = [
        make_row(
            f"made_up/{row}", name, repeat, bool(outcomes[row, column, repeat]), task=f"task_{cluster[row] % 5}", target=f"object_{cluster[row]}"
        )
        for row, group in enumerate(cluster)
        for column, name in enumerate(names)
        for repeat in range(repeats)
    ]
    write_log(folder, rows, {f"made_up/{row}": contexts[row] for row in range(instances)})
    return Synthetic(folder, names, contexts, cluster, rates)
