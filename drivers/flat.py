"""Flat settings: the fields of nested frozen dataclasses under their own names, as files and options write them.

`Wiring` inside `PM16CSettings` is a value of its own; in a file and in a URL its fields stand beside the others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args, get_type_hints

T = TypeVar("T")


@dataclass(frozen=True)
class FlatField:
    """A field of a plain type, or that type or None. `default` is MISSING if a value must be given."""

    name: str
    type: Any
    default: Any
    metadata: Mapping[str, Any]

    @property
    def plain(self) -> Any:
        """The type without None."""
        if not isinstance(self.type, UnionType):
            return self.type
        (plain,) = (part for part in get_args(self.type) if part is not NoneType)
        return plain

    @property
    def optional(self) -> bool:
        """Whether it may be None."""
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
