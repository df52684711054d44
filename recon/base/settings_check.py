"""Checks of settings classes: types and bounds of their fields, with one sentence for each kind of error."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import fields
from types import MappingProxyType, NoneType
from typing import Any, get_args

from recon.base.declared_types import is_number, is_of_type, lone, plain, refusal, shown, types_of

_Kind = tuple[Mapping[str, Any], Callable[[Any, Any], bool], Callable[[Any], str]]
"""Bounds by name, whether a value is within one, and what is expected."""
_NONE: Mapping[str, Any] = MappingProxyType({})


def check_settings(
    settings: Any,
    *,
    whole: Mapping[str, int | tuple[int, int]] = _NONE,
    least: Mapping[str, float] = _NONE,
    above: Mapping[str, float] = _NONE,
) -> None:
    """Raise ValueError for a value that a settings class does not take: of another type than its field declares, a name
    that is not among those of a Literal, or a number beyond a bound.

    What is no number, such as None, has no bound where the field's type has it. An array without axes, as an .npz gives
    a number, becomes the number.

    Args:
        settings: a dataclass.
        whole: whole numbers, by name: the least one, or the least and the largest.
        least, above: finite numbers, with the least one, or the number that they are above.
    """
    owner: Any = type(settings)
    declared = types_of(owner)
    given = [each.name for each in fields(settings) if each.init]
    for name in given:
        value = getattr(settings, name)
        if lone(value) and is_of_type(plain(value), declared.get(name, Any)):
            object.__setattr__(settings, name, plain(value))
    bounded: tuple[_Kind, ...] = (
        (whole, _is_whole, _whole_words),
        (least, lambda value, low: low <= value < math.inf, lambda low: f"finite and {low:g} or more"),
        (above, lambda value, low: low < value < math.inf, lambda low: f"finite and above {low:g}"),
    )
    for bounds, accepts, words in bounded:
        for name, bound in bounds.items():
            value, kind = getattr(settings, name), declared[name]
            if (is_number(value) or _only_numbers(value, kind)) and not _holds(accepts, value, bound):
                raise ValueError(f"{name} must be {words(bound)}, got {shown(value)}")
    for name in given:
        kind = declared.get(name, Any)
        if not is_of_type(value := getattr(settings, name), kind):
            raise ValueError(refusal(name, value, kind))


def _only_numbers(value: Any, kind: Any) -> bool:
    """Whether the field's type lacks this value, which is no number, and has no more to offer than numbers and None."""
    return not is_of_type(value, kind) and set(get_args(kind) or (kind,)) <= {int, float, NoneType}


def _holds(accepts: Callable[[Any, Any], bool], value: Any, bound: Any) -> bool:
    try:
        return not isinstance(value, bool) and accepts(value, bound)
    except (TypeError, ValueError):  # text, a number that is not whole, or several
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
