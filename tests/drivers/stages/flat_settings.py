"""Settings of a stage and builds of its simulated controller from keywords, for tests that change a few of them."""

from __future__ import annotations

from enum import StrEnum
from typing import Any, TypeVar

from drivers.flat import flat_fields, from_flat

T = TypeVar("T")


def flat(kind: type[T], **values: Any) -> T:
    """The dataclass with these values of it and of the values in it; choices may be given by their text."""
    types = {field.name: field.type for field in flat_fields(kind)}
    choices = {name: types[name](value) for name, value in values.items() if _is_choice(types.get(name))}
    return from_flat(kind, values | choices)


def _is_choice(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, StrEnum)
