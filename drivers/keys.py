"""Keys: how a configuration writes the fields of a driver's settings, a frozen dataclass.

`key` says with each field its unit, which ends the key's name, its legal values and its meaning.
"""

from __future__ import annotations

import dataclasses
import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any

ANGULAR = {"deg", "deg_s", "deg_s2"}  # Units of keys whose fields are in radians
MEGABYTES = "mb"  # The unit of keys whose fields are in bytes


@dataclass(frozen=True)
class Key:
    """How a configuration writes a field.

    Attributes:
        unit: ending of the key's name; "" without one.
        default: in that unit; MISSING if the key is required.
        doc: its meaning, if the name does not tell.
        bounds: legal values, by pydantic's names: gt, ge, le, pattern, min_length.
        problem: says what is wrong with a text; "" where nothing is. None: nothing can be.
    """

    unit: str
    default: Any
    doc: str
    bounds: Mapping[str, Any]
    problem: Callable[[str], str] | None = None

    def name_of(self, field: str) -> str:
        return f"{field}_{self.unit}" if self.unit else field

    @property
    def converted(self) -> bool:
        """Whether the field has another unit than the key."""
        return self.unit in ANGULAR or self.unit == MEGABYTES

    def inside(self, value: Any) -> Any:
        """A number from the configuration in the unit of the field."""
        if value is None or not self.converted:
            return value
        return math.radians(value) if self.unit in ANGULAR else value * 1_000_000

    def fault(self, value: Any) -> str:
        """What is wrong with the value of a field by its bounds; "" where nothing is."""
        if isinstance(value, float) and not math.isfinite(value):
            return "expected a finite number"
        if value is None:
            return ""
        bounds = {name: self.inside(bound) for name, bound in self.bounds.items()}
        if not all(_WITHIN[name](value, bound) for name, bound in bounds.items()):
            return f"expected {' and '.join(f'{_WORDS[name]} {bound}' for name, bound in bounds.items())}"
        return "" if self.problem is None else self.problem(value)


_WITHIN: Mapping[str, Callable[[Any, Any], Any]] = {
    "gt": operator.gt,
    "ge": operator.ge,
    "le": operator.le,
    "pattern": lambda text, pattern: re.fullmatch(pattern, text),
    "min_length": lambda value, least: len(value) >= least,
}
_WORDS = {"gt": ">", "ge": ">=", "le": "<=", "pattern": "text of the form", "min_length": "a length of at least"}


class CheckedSettings:
    """Settings whose fields are within the bounds that their keys declare.

    Raises:
        ValueError: one is not.
    """

    def __post_init__(self) -> None:
        settings: Any = self
        for field in fields(settings):
            value, written = getattr(self, field.name), field.metadata.get("key")
            if isinstance(written, Key) and (fault := written.fault(value)):
                raise ValueError(f"{type(self).__name__}.{field.name} is {value!r}: {fault}")


def key(
    default: Any = MISSING, doc: str = "", *, unit: str = "", problem: Callable[[str], str] | None = None, **bounds: Any
) -> Any:
    """A dataclass field that a configuration writes; `default` in the key's unit."""
    written = Key(unit, default, doc, bounds, problem)
    inside = default if default is MISSING else written.inside(default)
    return dataclasses.field(default=inside, metadata={"key": written})
