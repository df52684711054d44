"""Declared types: whether a value is what a field or an argument declares, and the sentence that refuses it.

Of an array only that it is one is looked at: the functions that take it name the shape and the numbers they expect.
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

_SCALARS = {complex, bytes, str}  # of ArrayLike, beside types of numpy's own
_NUMBERS = "ArrayLike"  # stands for its members
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
    """Stands for a type that is imported for the type checker alone; every value is of it."""

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
    """Whether the value is a real number, or an array without axes that holds one, as an .npz gives it.

    True and False are none.
    """
    value = plain(value)
    return isinstance(value, Real) and not isinstance(value, bool)


def plain(value: Any) -> Any:
    """The number or truth value in an array without axes, or of numpy; other values unchanged."""
    return value.item() if isinstance(value, np.ndarray | np.bool_) and value.shape == () else value


def is_of_type(value: Any, kind: Any) -> bool:
    """Whether a value is of a declared type."""
    alternatives = _alternatives(kind)
    return any(_fits(plain(value), each) for each in alternatives)


def _alternatives(kind: Any) -> list[Any]:
    """The members of a union, with those of `ArrayLike` as one; a list of the type itself for others."""
    if get_origin(kind) not in (Union, UnionType):
        return [kind]
    # numpy names ArrayLike by `type` from Python 3.12 on
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
    """Also an array, which is no `Sequence`."""
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
    """The sentence that refuses a value of the wrong type; without a full stop."""
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
    """Raise ValueError for an argument of another type than the function declares, or a number beyond its bounds.

    So it does for masked values: numpy computes with what lies below a mask. A function that can leave them out calls
    `without_mask` before.

    Args:
        values: by name, such as `locals()` in the function's first line.
    """
    declared = types_of(function)
    for name, value in values.items():
        if without_mask(value) is not value:
            raise ValueError(
                f"{name} has masked values, which this function cannot leave out: give an array without those views, "
                "or one in which they are filled"
            )
        if name in declared and not is_of_type(value, declared[name]):
            raise ValueError(refusal(name, value, declared[name]))


class Checked:
    """A settings class, as a dataclass: its values are checked against what its fields declare."""

    def __post_init__(self) -> None:
        check_settings(self)


def check_settings(settings: Any) -> None:
    """Raise ValueError for a value of a dataclass that its field does not declare: of another type, a name that is not
    among those of a Literal, or a number beyond the field's bounds.

    An array without axes, as an .npz gives a number, becomes the number.
    """
    values = {each.name: plain(getattr(settings, each.name)) for each in fields(settings) if each.init}
    check_arguments(type(settings), values)
    for name, value in values.items():
        object.__setattr__(settings, name, value)
