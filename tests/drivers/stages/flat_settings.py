"""Settings of a stage and its simulated controller from keywords, for tests that change a few of them."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from enum import StrEnum
from typing import Any, TypeVar, get_type_hints

T = TypeVar("T")


def flat(kind: type[T], **values: Any) -> T:
    """The dataclass with these values of it and of the values in it; choices may be given by their text."""
    made, used = _made(kind, values)
    assert used == values.keys(), values.keys() - used
    return made


def _made(kind: Any, values: dict[str, Any]) -> tuple[Any, set[str]]:
    types, chosen, used = get_type_hints(kind), {}, set[str]()
    for name in (field.name for field in fields(kind)):
        if is_dataclass(types[name]):
            chosen[name], inner = _made(types[name], values)
            used |= inner
        elif name in values:
            choice = isinstance(types[name], type) and issubclass(types[name], StrEnum)
            chosen[name] = types[name](values[name]) if choice else values[name]
            used.add(name)
    return kind(**chosen), used
