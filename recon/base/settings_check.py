"""What every settings class checks of its plain values, with one sentence for each kind of them."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from types import MappingProxyType
from typing import Any

from recon.base.registry import unknown

_Kind = tuple[Mapping[str, Any], Callable[[Any, Any], bool], Callable[[Any], str]]
"""Bounds by name, whether a value is within one, and what is expected."""
_NONE: Mapping[str, Any] = MappingProxyType({})


def check_settings(
    settings: Any,
    *,
    whole: Mapping[str, int | tuple[int, int]] = _NONE,
    least: Mapping[str, float] = _NONE,
    above: Mapping[str, float] = _NONE,
    choices: Mapping[str, Iterable[str]] = _NONE,
) -> None:
    """Raise ValueError for a value that a settings class does not take. None is taken where the field's type has it.

    Args:
        settings: a dataclass.
        whole: whole numbers, by name: the least one, or the least and the largest.
        least, above: finite numbers, with the least one, or the number that they are above.
        choices: names, with all that are legal.
    """
    optional = {field.name for field in fields(settings) if "None" in str(field.type)}
    kinds: tuple[_Kind, ...] = (
        (whole, _is_whole, _whole_words),
        (least, lambda value, low: low <= value < math.inf, lambda low: f"finite and {low:g} or more"),
        (above, lambda value, low: low < value < math.inf, lambda low: f"finite and above {low:g}"),
    )
    for bounds, accepts, words in kinds:
        for name, bound in bounds.items():
            value = getattr(settings, name)
            if not (value is None and name in optional) and not _holds(accepts, value, bound):
                raise ValueError(f"{name} must be {words(bound)}, got {value!r}")
    for name, legal in choices.items():
        if getattr(settings, name) not in (names := tuple(legal)):
            raise ValueError(unknown(name, getattr(settings, name), names))


def _holds(accepts: Callable[[Any, Any], bool], value: Any, bound: Any) -> bool:
    try:
        return not isinstance(value, bool) and accepts(value, bound)
    except TypeError:  # text, or a number that is not whole
        return False


def _is_whole(value: Any, bound: int | tuple[int, int]) -> bool:
    low, high = (bound, math.inf) if isinstance(bound, int) else bound
    return low <= operator.index(value) <= high


def _whole_words(bound: int | tuple[int, int]) -> str:
    return (
        f"a whole number of {bound} or more"
        if isinstance(bound, int)
        else "a whole number from {} to {}".format(*bound)
    )
