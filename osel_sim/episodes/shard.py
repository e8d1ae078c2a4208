"""A shard: one of several parts of a recording that are made on their own, on one machine or many, and put together afterwards."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from osel_sim.core.errors import SettingError

_FORM = re.compile(r"(\d{1,9})/(\d{1,9})", re.ASCII)


@dataclass(frozen=True)
class Shard:
    """Part `number` of `of`, counted from 1; `3/40` as text.

    A shard has neighbouring instances with all their episodes: every policy of an instance lies in one shard, few tasks are loaded in each, and the
    shards one after another are the whole in its order.
    """

    number: int
    of: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `3/40`.

        Raises:
            SettingError: it is something else, or a number beyond the last.
        """
        found = _FORM.fullmatch(text)
        number, of = (int(part) for part in found.groups()) if found else (0, 0)
        if not 1 <= number <= of:
            raise SettingError("shard", f"must be NUMBER/ALL, such as 3/40 for the third of forty, the first being 1/40; got {text!r}")
        return cls(number, of)

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    def part[T](self, whole: Sequence[T]) -> Sequence[T]:
        """What of the whole is this shard's: neighbours, of which no shard has more than one above another.

        Raises:
            SettingError: there are more shards than things.
        """
        if self.of > len(whole):
            raise SettingError("shard", f"{self}, but there are {len(whole)} instances, and no shard may be empty")
        return whole[(self.number - 1) * len(whole) // self.of : self.number * len(whole) // self.of]
