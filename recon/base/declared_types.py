"""Declared types: checks that a value has the type that its field or argument declares, and words the error message.

For an array only the type is checked. The functions that take the array check its shape and its values.
"""

from __future__ import annotations

import builtins
import inspect
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from enum import Enum
from functools import cache
from numbers import Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from recon.base.arrays import without_mask
from recon.base.registry import unknown

_SCALARS = {complex, bytes, str}  # members of ArrayLike that are not numpy types
_NUMBERS = "ArrayLike"  # short for all its members
_LONGEST = 80  # characters of a value in a sentence
_WORDS: Mapping[Any, str] = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "text",
    NoneType: "None",
    Callable: "a function",
    Mapping: "a mapping",
    np.ndarray: "an array",
    _NUMBERS: "an array of numbers",
}


class _Unresolved:
    """Placeholder for a type that only the type checker imports. Every value passes the check."""

    def __class_getitem__(cls, parameters: object) -> type[_Unresolved]:
        return cls


class _Names(dict[str, Any]):
    def __missing__(self, name: str) -> Any:
        if hasattr(builtins, name):
            raise KeyError(name)
        return _Unresolved


@cache
def types_of(owner: Any) -> Mapping[str, Any]:
    """The declared types of a dataclass's fields or a function's arguments, by name."""
    modules = [each.__module__ for each in reversed(inspect.getmro(owner) if isinstance(owner, type) else (owner,))]
    names = _Names({name: value for module in modules for name, value in vars(sys.modules[module]).items()})
    return get_type_hints(owner, None, names, include_extras=True)


def is_number(value: object) -> bool:
    """Whether the value is a real number, or an array without axes that contains one. (numpy reads numbers from .npz
    files as arrays without axes.)

    True and False do not count as numbers.
    """
    value = plain(value)
    return isinstance(value, Real) and not isinstance(value, bool)


def plain(value: Any) -> Any:
    """The plain Python number or bool in a numpy scalar or in an array without axes. Other values are returned
    unchanged."""
    return value.item() if isinstance(value, np.ndarray | np.bool_) and value.shape == () else value


def is_of_type(value: Any, kind: Any) -> bool:
    """Whether a value is of a declared type."""
    alternatives = _alternatives(kind)
    return any(_fits(plain(value), each) for each in alternatives)


def _alternatives(kind: Any) -> list[Any]:
    """The members of a union, with `ArrayLike` as one member; for another type a list with this type."""
    if get_origin(kind) not in (Union, UnionType):
        return [kind]
    # from Python 3.12 on, numpy defines ArrayLike with a `type` statement
    members = [part for each in get_args(kind) for part in get_args(getattr(each, "__value__", None)) or [each]]
    if not set(members) >= _SCALARS:
        return members
    return [_NUMBERS, *(each for each in members if each not in _SCALARS and "numpy._typing" not in str(each))]


def _fits(value: Any, kind: Any) -> bool:
    origin, args = get_origin(kind) or kind, get_args(kind)
    if origin is Annotated:
        return is_of_type(value, args[0]) and not args[1].fault(value)
    if origin is Literal:
        return isinstance(value, str | int) and value in args
    if origin is int:
        return hasattr(value, "__index__") and not isinstance(value, bool)
    if origin is float:
        return is_number(value) and not math.isnan(value)
    if origin in (Callable, _NUMBERS):
        return callable(value) if origin is Callable else _is_numeric(value)
    if origin is tuple or origin is Sequence:
        return _is_sequence(value) and _each_fits(value, args)
    return _is_instance(value, origin)


def _is_numeric(value: Any) -> bool:
    return is_number(value) or isinstance(value, bool) or hasattr(value, "__array__") or _is_sequence(value)


def _is_sequence(value: Any) -> bool:
    """Whether the value is a sequence or an array (an array does not count as a `Sequence` in Python)."""
    return hasattr(value, "__len__") and hasattr(value, "__getitem__") and not isinstance(value, str | bytes | Mapping)


def _each_fits(values: Any, kinds: tuple[Any, ...]) -> bool:
    if len(kinds) == 2 and kinds[1] is not ...:
        return len(values) == 2 and all(map(is_of_type, values, kinds))
    if len(kinds) < 3:
        return all(is_of_type(value, kinds[0]) for value in values)
    return len(values) == len(kinds) and all(map(is_of_type, values, kinds))


def _is_instance(value: Any, kind: Any) -> bool:
    if kind is np.ndarray:
        return hasattr(value, "__array__")
    if not isinstance(kind, type) or kind in (Any, _Unresolved) or str(kind.__module__).startswith("numpy"):
        return True  # such as a type variable
    if issubclass(kind, Enum):
        return isinstance(value, kind) or value in [member.value for member in kind]
    if getattr(kind, "_is_protocol", False) and not getattr(kind, "_is_runtime_protocol", False):
        return not isinstance(value, type)
    return isinstance(value, kind) and not isinstance(value, type)


def words(kind: Any) -> str:
    """The name of a declared type in a sentence, such as "a whole number or None"."""
    return " or ".join(_word(each) for each in sorted(_alternatives(kind), key=lambda each: each is NoneType))


def _word(kind: Any) -> str:
    origin, args = get_origin(kind) or kind, get_args(kind)
    if origin is Annotated:
        return f"{_WORDS[args[0]]} {args[1].words}"
    if origin is Literal:
        return " or ".join(map(repr, args))
    if origin is tuple and args[-1:] != (...,):
        return f"{len(args)} values, each {words(args[0])}"
    if origin in (tuple, Sequence):
        return f"a list or tuple, each value {words(args[0])}"
    name = getattr(origin, "__name__", str(origin))
    return _WORDS.get(origin, f"{'an' if name[:1] in 'AEIO' else 'a'} {name}")


def refusal(name: str, value: Any, kind: Any) -> str:
    """The error message for a value of the wrong type, without a full stop."""
    alternatives = _alternatives(kind)
    names = [member for each in alternatives if get_origin(each) is Literal for member in get_args(each)]
    names += [
        member.value for each in alternatives if isinstance(each, type) and issubclass(each, Enum) for member in each
    ]
    if names and all(isinstance(member, str) for member in names):
        return unknown(name, value, names)
    instead = f"; give an object, such as {value.__name__}()" if isinstance(value, type) else ""
    return f"{name} must be {words(kind)}, got {shown(value)}{instead}"


def shown(value: object) -> str:
    """A value as text within a sentence."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if (shape := getattr(value, "shape", None)) not in (None, ()):
        return f"{type(value).__name__} of shape {shape}"
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def check_arguments(function: Callable[..., Any], values: Mapping[str, Any]) -> None:
    """Raise ValueError if an argument has another type than the function declares, or a number is out of bounds.

    It also raises ValueError for masked values, because numpy would compute with the numbers under the mask. A function
    that can leave masked values out calls `without_mask` first.

    Args:
        values: by name, such as `locals()` in the function's first line.
    """
    declared = types_of(function)
    for name, value in values.items():
        if without_mask(value) is not value:
            raise ValueError(
                f"{name} has masked values, which this function cannot leave out. Remove the projections with masked "
                "values, or fill the masked values first"
            )
        if name in declared and not is_of_type(value, declared[name]):
            raise ValueError(refusal(name, value, declared[name]))


class Checked:
    """Base class of settings (dataclasses): checks every value against the declaration of its field."""

    def __post_init__(self) -> None:
        check_settings(self)


def check_settings(settings: Any) -> None:
    """Raise ValueError if a value of a dataclass does not match the declaration of its field.

    A value does not match if it has another type, if it is a name that the field's Literal does not contain, or if it
    is a number outside the field's bounds.

    An array without axes is replaced by the number in it, because numpy reads a number from an .npz file as such an
    array.
    """
    values = {each.name: plain(getattr(settings, each.name)) for each in fields(settings) if each.init}
    check_arguments(type(settings), values)
    for name, value in values.items():
        object.__setattr__(settings, name, value)
