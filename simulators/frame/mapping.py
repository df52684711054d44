"""Mapping: a frozen dataclass from a YAML mapping; unknown or missing keys and wrong types are refused by name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from types import MappingProxyType, NoneType, UnionType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")


class SceneError(ValueError):
    """A scene's mapping is wrong; the message names the key, what it holds and what is legal."""


def build(cls: type[T], where: str, mapping: Any) -> T:
    """`cls(**mapping)` for a dataclass of plain fields: numbers, words, true or false, lists and mappings of these,
    dataclasses of such fields, and None for what may be left out.

    Raises:
        SceneError: naming the key (`where` is its path) and the legal ones.
    """
    declared = [field for field in fields(cls) if field.init]
    needed = [field.name for field in declared if field.default is MISSING and field.default_factory is MISSING]
    entries = keys(where, mapping, legal=[field.name for field in declared], needed=needed)
    hints = get_type_hints(cls)
    values = {key: _value(f"{where}.{key}", hints[key], value) for key, value in entries.items()}
    try:
        return cls(**values)
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from None


def keys(where: str, mapping: Any, *, legal: Sequence[str], needed: Sequence[str] = ()) -> Mapping[str, Any]:
    """The mapping itself, once its keys are known to be legal and complete."""
    if not isinstance(mapping, Mapping):
        raise SceneError(f"{where} must be a mapping with the keys {', '.join(legal)}; got {mapping!r}")
    if unknown := [key for key in mapping if key not in legal]:
        raise SceneError(f"{where}: key {unknown[0]!r} is unknown; legal: {', '.join(legal) or 'none'}")
    if missing := [key for key in needed if key not in mapping]:
        raise SceneError(f"{where}: key {missing[0]!r} is missing; needed: {', '.join(needed)}")
    return mapping


def named(where: str, legal: Sequence[str], entry: Any) -> tuple[str, Mapping[str, Any]]:
    """The kind that an entry names and the rest of its keys: a bare name, or a mapping with a `kind`."""
    kind = entry.get("kind") if isinstance(entry, Mapping) else entry
    if not isinstance(kind, str) or kind not in legal:
        raise SceneError(f"{where}: kind {kind!r} is unknown; legal: {', '.join(legal)}")
    rest = {key: value for key, value in entry.items() if key != "kind"} if isinstance(entry, Mapping) else {}
    return kind, rest


def choose(where: str, choices: Mapping[str, type[Any]], entry: Any) -> Any:
    """The dataclass that an entry names, built from the rest."""
    kind, rest = named(where, list(choices), entry)
    return build(choices[kind], f"{where} ({kind})", rest)


def items(where: str, key: str, mapping: Mapping[str, Any]) -> list[tuple[int, Any]]:
    """The entries of a list, numbered; an absent one is empty."""
    entries = mapping.get(key) or []
    if not isinstance(entries, list | tuple):
        raise SceneError(f"{where}: {key} must be a list, got {entries!r}")
    return list(enumerate(entries))


def number(where: str, value: Any) -> float:
    """A finite float. Text that reads as a number is one: YAML 1.1 takes 1e5 and 1.0e5 (no sign) for text."""
    try:
        read = float(value) if isinstance(value, int | float | str) and not isinstance(value, bool) else math.nan
    except ValueError:
        read = math.nan
    if not math.isfinite(read):
        raise SceneError(f"{where} must be a finite number, got {value!r}")
    return read


def _value(where: str, kind: Any, value: Any) -> Any:
    origin, choices = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):  # only "something | None" is declared
        (inner,) = (choice for choice in choices if choice is not NoneType)
        return None if value is None else _value(where, inner, value)
    if origin is Literal:
        if value not in choices:
            raise SceneError(f"{where} must be one of {', '.join(map(str, choices))}, got {value!r}")
        return value
    if origin is tuple:
        return _values(where, choices, value)
    if origin is Mapping:
        return _entries(where, choices, value)
    if isinstance(kind, type) and is_dataclass(kind):
        return build(kind, where, value)
    if kind is bool or kind is str:
        if not isinstance(value, kind):
            raise SceneError(f"{where} must be {'true or false' if kind is bool else 'text'}, got {value!r}")
        return value
    if kind is int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise SceneError(f"{where} must be a whole number, got {value!r}")
        return value
    return number(where, value)


def _entries(where: str, kinds: tuple[Any, ...], value: Any) -> Mapping[Any, Any]:
    """A mapping from whole numbers or names; a number may stand as text, as JSON has its keys."""
    if not isinstance(value, Mapping):
        raise SceneError(f"{where} must be a mapping, got {value!r}")
    of_key, of_value = kinds
    entries = {}
    for key, entry in value.items():
        read = int(key) if of_key is int and isinstance(key, str) and key.isdecimal() else key
        entries[_value(f"{where}: key", of_key, read)] = _value(f"{where}.{key}", of_value, entry)
    return MappingProxyType(entries)


def _values(where: str, kinds: tuple[Any, ...], value: Any) -> tuple[Any, ...]:
    """A list as a tuple; `kinds` are those of its items, or one and an ellipsis for a list of any length."""
    endless = kinds[-1] is Ellipsis
    if not isinstance(value, list | tuple) or not (endless or len(value) == len(kinds)):
        what = "numbers" if all(kind in (int, float) for kind in kinds if kind is not Ellipsis) else "entries"
        raise SceneError(f"{where} must be a list of {'' if endless else f'{len(kinds)} '}{what}, got {value!r}")
    each = kinds[:1] * len(value) if endless else kinds
    return tuple(_value(f"{where}[{i}]", kind, v) for i, (kind, v) in enumerate(zip(each, value, strict=True)))
