"""Flat settings: the fields of nested frozen dataclasses under their own names, as files and options write them.

`key` says with a field how a configuration writes it: its unit, which ends the key's name, legal values and meaning.
`Wiring` inside `PM16CSettings` is a value of its own; in a file and in a URL its fields stand beside the others.
"""

from __future__ import annotations

import dataclasses
import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args, get_type_hints

T = TypeVar("T")
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


class Declared:
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


@dataclass(frozen=True)
class FlatField:
    """A field of a plain type, or that type or None. `default` is MISSING if a value must be given."""

    name: str
    type: Any
    default: Any
    metadata: Mapping[str, Any]

    @property
    def plain(self) -> Any:
        """The type without None; a union of others stays as it is."""
        if not isinstance(self.type, UnionType) or NoneType not in get_args(self.type):
            return self.type
        (plain,) = (part for part in get_args(self.type) if part is not NoneType)
        return plain

    @property
    def optional(self) -> bool:
        """Whether the field may be None."""
        return self.plain is not self.type


def flat_fields(settings: type[Any]) -> list[FlatField]:
    """The fields of a dataclass in their order, those of a nested one in its place; its default has their defaults."""
    return _fields_of(settings, MISSING)


def _fields_of(settings: type[Any], defaults: Any) -> list[FlatField]:
    hints, flat_fields = get_type_hints(settings), list[FlatField]()
    for field in fields(settings):
        default = field.default if defaults is MISSING else getattr(defaults, field.name)
        if is_dataclass(hints[field.name]):
            flat_fields += _fields_of(hints[field.name], default)
        else:
            flat_fields.append(FlatField(field.name, hints[field.name], default, field.metadata))
    return flat_fields


def from_flat(settings: type[T], values: Mapping[str, Any]) -> T:
    """The dataclass with these values; other fields have their defaults.

    Raises:
        TypeError: no field has the name, or a field without default is missing.
        ValueError: values that the dataclass, or a nested one, refuses.
    """
    known = {field.name for field in flat_fields(settings)}
    if unknown := sorted(values.keys() - known):
        raise TypeError(f"{settings.__name__} has no field {', '.join(unknown)}; it has {', '.join(sorted(known))}")
    return _built(settings, values, MISSING)


def _built(settings: type[T], values: Mapping[str, Any], defaults: Any) -> T:
    hints, chosen = get_type_hints(settings), dict[str, Any]()
    for field in fields(settings):  # type: ignore[arg-type]
        default = field.default if defaults is MISSING else getattr(defaults, field.name)
        if is_dataclass(hints[field.name]):
            chosen[field.name] = _built(hints[field.name], values, default)
        elif field.name in values:
            chosen[field.name] = values[field.name]
        elif default is not MISSING:
            chosen[field.name] = default
    return settings(**chosen)
