"""What the configurations of all commands share: one frozen dataclass each, the only place a setting is named, typed, documented and checked.

The command line is derived from it (`osel_sim.cli.command`), a file given with `--config` holds it, `run.json` records it, and the functions of the
Python API take it as keywords. A field's docstring is its help; `Group` says under which heading `--help` shows it.
"""

import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast, dataclass_transform

from annotated_types import Ge, MinLen
from pydantic import AfterValidator, AllowInfNan, BeforeValidator, ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as pydantic_dataclass

from osel_sim.core.errors import SettingError, UnknownNameError


@dataclass(frozen=True)
class Group:
    """Heading under which `--help` shows a field.

    Attributes:
        title: the heading.
        order: groups with a lower number come first.
    """

    title: str
    order: float


MAIN = Group("What matters most", 0)
INSTANCES = Group("Which instances", 1)
REWARD = Group("Reward", 2)
OUTPUT = Group("Output", 3)
CONTENT = Group("Files of your own", 4)
OTHER = Group("More", 5)


def _one_or_many(value: Any) -> Any:
    """A single string or path stands for a list of one: `task="lift"`."""
    return (value,) if isinstance(value, str | Path) else value


def _existing_folder(path: Path) -> Path:
    if not path.is_dir():
        raise ValueError(f"{path} is not a folder" if path.exists() else f"there is no folder {path}")
    if not os.access(path, os.R_OK | os.X_OK):
        raise ValueError(f"folder {path} cannot be read")
    return path


Count = Annotated[int, Ge(1)]
"""An integer of at least 1."""
Index = Annotated[int, Ge(0)]
"""An integer of at least 0."""
NonNegative = Annotated[float, Ge(0.0), AllowInfNan(False)]
"""A finite number of at least 0."""
Folder = Annotated[Path, AfterValidator(_existing_folder)]
"""A folder that exists and can be read."""
Names = Annotated[tuple[str, ...], BeforeValidator(_one_or_many)]
"""Names; one alone may stand without a list around it."""
Files = Annotated[tuple[Path, ...], BeforeValidator(_one_or_many)]
"""Files; one alone may stand without a list around it."""
Levels = Annotated[tuple[Index, ...], MinLen(1), BeforeValidator(lambda value: (value,) if isinstance(value, int) else value)]
"""Perturbation levels; one alone may stand without a list around it."""
Split = Literal["train", "validation", "test"]


class Settings:
    """Base of all configurations."""

    @classmethod
    def of(cls, **values: Any) -> Self:
        """Build and check a configuration.

        Raises:
            UnknownNameError: there is no such setting; names the nearest.
            SettingError: a value is of another type or out of range; names the setting.
        """
        known = [field.name for field in fields(cast(Any, cls))]
        for name in values:
            if name not in known:
                raise UnknownNameError("setting", name, known, cls.__name__)
        try:
            config = cls(**values)
        except ValidationError as error:
            raise _setting_error(error, cls) from None
        object.__setattr__(config, "_given", frozenset(values))
        return config

    @property
    def given(self) -> frozenset[str]:
        """Names of the settings that were given; the others have their defaults."""
        own = (field.name for field in fields(cast(Any, self)) if getattr(self, field.name) != field.default)
        return getattr(self, "_given", frozenset(own))

    def changed(self, **values: Any) -> Self:
        """The same configuration with some other values; raises as `of` does."""
        return self.of(**{name: getattr(self, name) for name in self.given} | values) if values else self

    def to_json(self) -> dict[str, Any]:
        """As values that JSON holds, all settings by name; `of(**to_json())` is the same configuration."""
        return cast(dict[str, Any], TypeAdapter(type(self)).dump_python(self, mode="json"))


@dataclass_transform(kw_only_default=True, frozen_default=True)
def settings[Config: type](cls: Config) -> Config:
    """Make a class a configuration: a frozen dataclass whose values are checked when it is made."""
    config = ConfigDict(extra="forbid", arbitrary_types_allowed=True)
    return cast(Config, pydantic_dataclass(frozen=True, kw_only=True, config=config)(cls))


def _setting_error(error: ValidationError, config: type) -> SettingError:
    """The first thing wrong with a configuration, in the words that files are told in."""
    from osel_sim.formats.schema_node import Node
    from osel_sim.formats.toml_faults import faults_of

    schema = TypeAdapter(config).json_schema()
    key, problem = faults_of(error, Node(schema, schema))[0]
    return SettingError(key.partition("[")[0], problem)


@settings
class RewardSettings(Settings):
    """Weights of the reward: success - alpha_time * time - alpha_price * price."""

    preset: Annotated[str | None, REWARD] = None
    """reward weights of the paper: mmlu, waymo, alfred, oxe (default: oxe)"""
    alpha_time: Annotated[NonNegative | None, REWARD] = None
    """weight of time in the reward (default: the preset's)"""
    alpha_price: Annotated[NonNegative | None, REWARD] = None
    """weight of the price in cents (default: the preset's)"""
    time_unit: Annotated[Literal["log10-seconds", "log10-steps", "steps"] | None, REWARD] = None
    """time in the reward (default: the preset's)"""


@settings
class LoggedRewardSettings(RewardSettings):
    """Weights of the reward of a log, which may have graded outcomes."""

    success: Annotated[Literal["success", "subgoals", "score"] | None, REWARD] = None
    """what counts as success in the reward (default: the preset's, and the score of a log of --metric action-mse)"""


@settings
class TrustSettings(Settings):
    """What data may ask for."""

    trust: Annotated[Names, OTHER] = ()
    """module, or model repository (owner/name), whose code a checkpoint may ask for; may be repeated (docs/security.md)"""


@settings
class ContentSettings(TrustSettings):
    """Folders with a user's own task and policy files."""

    tasks: Annotated[Folder | None, CONTENT] = None
    """folder with task files of your own"""
    policies_dir: Annotated[Folder | None, CONTENT] = None
    """folder with policy files of your own"""


@settings
class InstanceSettings(Settings):
    """Which instances of the tasks are meant."""

    level: Annotated[Levels, INSTANCES] = (0,)
    """how hard scenes are perturbed, 0 to 3; several mix"""
    axis: Annotated[Names, INSTANCES] = ()
    """AXIS=LEVEL: one axis at a level of its own, such as camera=2; repeatable"""
    action_noise: Annotated[NonNegative, INSTANCES] = 0.0
    """standard deviation of noise on the motions of every action, in units of action; 1 is 5 cm or half a radian"""
    split: Annotated[Split, INSTANCES] = "test"
    """which instances"""
    robot: Annotated[str | None, INSTANCES] = None
    """robot that does all of them, such as UR5e (default: the one each task file names, else Panda)"""
