"""Declared types: whether a value is of the type that a field or an argument declares, and how a sentence names it.

Of an array only that it is one is looked at: the functions that take it name the shape and the numbers they expect.
"""

from __future__ import annotations

import inspect
import math
import operator
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from enum import Enum
from functools import cache
from numbers import Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

from recon.base.arrays import without_mask
from recon.base.registry import unknown

_ARRAYS = frozenset(get_args(getattr(ArrayLike, "__value__", ArrayLike)))  # numpy names it by `type` from Python 3.12
_LONGEST = 80  # characters of a value in a sentence
_WORDS: Mapping[Any, tuple[str, str]] = {
    bool: ("True or False", "of True and False"),
    int: ("a whole number", "whole numbers"),
    float: ("a number", "numbers"),
    str: ("text", "texts"),
    NoneType: ("None", "of None"),
    Callable: ("a function", "functions"),
    Mapping: ("a mapping", "mappings"),
    np.ndarray: ("an array", "arrays"),
}
"""How one and how several of a type are called."""


class Bound(NamedTuple):
    """Range of a number that a field declares: `Annotated[int, Bound(1, 16)]`.

    Attributes:
        low, high: ends that belong to it; `high` is of whole numbers alone.
        above: `low` itself does not belong to it.
    """

    low: int
    high: float = math.inf
    above: bool = False

    def holds(self, value: Any, whole: bool) -> bool:
        try:
            number = operator.index(value) if whole else value
            return not isinstance(value, bool) and self.low <= number <= self.high and (whole or self._inner(number))
        except (TypeError, ValueError):  # text, a number that is not whole, or several
            return False

    def _inner(self, number: float) -> bool:
        return number < math.inf and not (self.above and number == self.low)

    def words(self, whole: bool) -> str:
        if not whole:
            return f"finite and above {self.low}" if self.above else f"finite and {self.low} or more"
        ends = f"of {self.low} or more" if self.high == math.inf else f"from {self.low} to {self.high}"
        return f"a whole number {ends}"


Natural = Annotated[int, Bound(0)]
Count = Annotated[int, Bound(1)]
NonNegative = Annotated[float, Bound(0)]
Positive = Annotated[float, Bound(0, above=True)]


@cache
def _declared(owner: Any) -> tuple[Mapping[str, Any], Mapping[str, tuple[bool, Bound]]]:
    """Types by name, where they can be resolved; bounds of those that have one, and whether it is of whole numbers."""
    kinds, bounds = dict[str, Any](), dict[str, tuple[bool, Bound]]()
    for each in reversed(inspect.getmro(owner)) if isinstance(owner, type) else (owner,):
        for name, kind in inspect.get_annotations(each).items():
            one = type("_One", (), {"__annotations__": {name: kind}})
            kinds.pop(name, None)
            with suppress(NameError):  # a type that is imported for the type checker alone
                full = get_type_hints(one, names := vars(sys.modules[each.__module__]), {}, include_extras=True)[name]
                kinds |= get_type_hints(one, names, {})
                for part in (full, *get_args(full)):
                    if get_origin(part) is Annotated:
                        bounds[name] = get_args(part)[0] is int, get_args(part)[1]
    return kinds, bounds


def types_of(owner: Any) -> Mapping[str, Any]:
    """The declared types of a dataclass's fields or a function's arguments, by name, where they can be resolved."""
    return _declared(owner)[0]


def is_number(value: object) -> bool:
    """Whether the value is a real number, or an array without axes that holds one, as an .npz gives it.

    True and False are none.
    """
    value = plain(value)
    return isinstance(value, Real) and not isinstance(value, bool)


def lone(value: Any) -> bool:
    """Whether the value is an array without axes, or numpy's True or False."""
    return isinstance(value, np.bool_) or (
        getattr(value, "shape", None) == () and hasattr(value, "item") and not isinstance(value, np.generic)
    )


def plain(value: Any) -> Any:
    """The number or truth value in an array without axes; other values unchanged."""
    return value.item() if lone(value) else value


def is_of_type(value: Any, kind: Any) -> bool:
    """Whether a value is of a declared type."""
    origin, args = _parts(kind)
    if kind is None or kind is NoneType:
        return value is None
    if origin in (Union, UnionType):
        others = _without_arrays(args)
        return (len(others) < len(args) and _is_numeric(value)) or any(is_of_type(value, each) for each in others)
    if origin is Literal:
        return isinstance(value, str | int) and value in args
    if kind is bool:
        return isinstance(value, bool | np.bool_)
    if kind is int:
        return not isinstance(value, bool) and _is_whole(value)
    if kind is float:
        return is_number(value) and not math.isnan(value)
    if origin is tuple:
        return _is_sequence(value) and _each_fits(value, args)
    if origin is Callable:
        return callable(value)
    if origin is Mapping and args:
        return isinstance(value, Mapping) and all(is_of_type(each, args[1]) for each in value.values())
    return _is_instance(value, origin) and (not _is_of_sequences(origin, args) or _each_fits(value, (*args, ...)))


def _parts(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """What a type is made of: its origin or itself, and its arguments; names by `type` (Python 3.12) are unfolded."""
    kind = getattr(kind, "__value__", kind) if not isinstance(kind, type) else kind
    origin, args = get_origin(kind) or kind, get_args(kind)
    if origin in (Union, UnionType):
        unfolded = [get_args(each.__value__) if hasattr(each, "__value__") else (each,) for each in args]
        args = tuple(part for parts in unfolded for part in parts)
    return origin, args


def _without_arrays(alternatives: tuple[Any, ...]) -> tuple[Any, ...]:
    """The alternatives of a type without those of `ArrayLike`, if it has them all."""
    if not set(alternatives) >= _ARRAYS:
        return alternatives
    return tuple(each for each in alternatives if each not in _ARRAYS)


def _is_numeric(value: Any) -> bool:
    """Whether numpy makes an array of numbers of it."""
    if value is None or isinstance(value, type) or callable(value):
        return False
    try:
        stated = getattr(getattr(value, "dtype", None), "kind", None)  # of a data set in a file, which is not read
        return (stated or np.asarray(value).dtype.kind) in "biufc"
    except (TypeError, ValueError, RuntimeError):
        return False


def _is_whole(value: Any) -> bool:
    try:
        operator.index(value)
    except TypeError:
        return False
    return True


def _is_sequence(value: Any) -> bool:
    """Also an array, which is no `Sequence`."""
    return hasattr(value, "__len__") and hasattr(value, "__getitem__") and not isinstance(value, str | bytes | Mapping)


def _is_of_sequences(origin: Any, args: tuple[Any, ...]) -> bool:
    return isinstance(origin, type) and issubclass(origin, Sequence) and origin is not str and len(args) == 1


def _each_fits(values: Any, kinds: tuple[Any, ...]) -> bool:
    if len(kinds) == 2 and kinds[1] is ...:
        return all(is_of_type(value, kinds[0]) for value in values)
    return len(values) == len(kinds) and all(is_of_type(*each) for each in zip(values, kinds, strict=True))


def _is_instance(value: Any, kind: Any) -> bool:
    if kind is np.ndarray:
        return hasattr(value, "__array__")
    if kind is Any or not isinstance(kind, type) or str(kind.__module__).startswith("numpy"):
        return True  # such as a type variable
    if issubclass(kind, Enum):
        return isinstance(value, kind) or value in [member.value for member in kind]
    if getattr(kind, "_is_protocol", False):
        if kind.__module__ in ("typing", "collections.abc"):
            return isinstance(value, kind)
        bases = [base for base in kind.__mro__ if getattr(base, "_is_protocol", False)]
        names = {name for base in bases for name in (*vars(base), *inspect.get_annotations(base)) if name[0] != "_"}
        return not isinstance(value, type) and all(hasattr(value, name) for name in names)
    if issubclass(kind, Sequence) and kind is not str:
        return _is_sequence(value)
    return isinstance(value, kind)


def words(kind: Any, several: bool = False) -> str:
    """The name of a declared type in a sentence, such as "a whole number or None"."""
    origin, args = _parts(kind)
    if origin in (Union, UnionType):
        others = _without_arrays(args)
        named = ["an array of numbers"] if len(others) < len(args) else []
        named += [words(each, several) for each in sorted(others, key=lambda each: each is NoneType)]
        return f"{', '.join(named[:-1])} or {named[-1]}" if len(named) > 1 else named[0]
    if origin is Literal:
        return " or ".join(map(repr, args))
    if origin is tuple and args[-1:] != (...,):
        return f"{len(args)} {words(args[0], True)}"
    if origin is tuple or _is_of_sequences(origin, args):
        return f"a list or tuple of {words(args[0], True)}"
    if origin in _WORDS:
        return _WORDS[origin][several]
    name = getattr(origin, "__name__", str(origin))
    return f"{name}s" if several else f"{'an' if name[:1] in 'AEIO' else 'a'} {name}"


def refusal(name: str, value: Any, kind: Any) -> str:
    """The sentence that refuses a value of the wrong type; without a full stop."""
    of = tuple(each for each in (get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)) if each)
    names = [member for each in of if get_origin(each) is Literal for member in get_args(each)]
    names += [member.value for each in of if isinstance(each, type) and issubclass(each, Enum) for member in each]
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
    """Raise ValueError for an argument of another type than the function declares, or a number beyond its `Bound`.

    So it does for masked values: numpy computes with what lies below a mask. A function that can leave them out calls
    `without_mask` before.

    Args:
        values: by name, such as `locals()` in the function's first line.
    """
    declared, bounds = _declared(function)
    for name, (whole, bound) in bounds.items():
        value, kind = values.get(name), declared[name]
        if (is_number(value) or _only_numbers(value, kind)) and not bound.holds(value, whole):
            raise ValueError(f"{name} must be {bound.words(whole)}, got {shown(value)}")
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
    """Raise ValueError for a value that a settings class does not take: of another type than its field declares, a name
    that is not among those of a Literal, or a number beyond the field's `Bound`.

    What is no number, such as None, has no bound where the field's type has it. An array without axes, as an .npz gives
    a number, becomes the number.

    Args:
        settings: a dataclass.
    """
    owner: Any = type(settings)
    declared = types_of(owner)
    names = [each.name for each in fields(settings) if each.init]
    for name in names:
        value = getattr(settings, name)
        if lone(value) and is_of_type(plain(value), declared.get(name, Any)):
            object.__setattr__(settings, name, plain(value))
    check_arguments(owner, {name: getattr(settings, name) for name in names})


def _only_numbers(value: Any, kind: Any) -> bool:
    """Whether the field's type lacks this value, which is no number, and has no more to offer than numbers and None."""
    return not is_of_type(value, kind) and set(get_args(kind) or (kind,)) <= {int, float, NoneType}
