"""Mapping: a frozen dataclass from a YAML mapping; unknown or missing keys and wrong types are refused by name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_origin, get_type_hints

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")


class SceneError(ValueError):
    """A scene's mapping is wrong; the message names the key, what it holds and what is legal."""


def build(cls: type[T], where: str, mapping: Any) -> T:
    """`cls(**mapping)` for a dataclass whose fields are float, int or tuples of floats.

    Raises:
        SceneError: naming the key (`where` is its path) and the legal ones.
    """
    declared = fields(cls)
    needed = [field.name for field in declared if field.default is MISSING]
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


def choose(where: str, choices: Mapping[str, type[Any]], entry: Any) -> Any:
    """The dataclass that an entry names, built from the rest: a bare name, or a mapping with a `kind`."""
    entry = {"kind": entry} if isinstance(entry, str) else entry
    if not isinstance(entry, Mapping) or entry.get("kind") not in choices:
        given = entry.get("kind") if isinstance(entry, Mapping) else entry
        raise SceneError(f"{where}: kind {given!r} is unknown; legal: {', '.join(choices)}")
    rest = {key: value for key, value in entry.items() if key != "kind"}
    return build(choices[entry["kind"]], f"{where} ({entry['kind']})", rest)


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
    if get_origin(kind) is tuple:
        n = len(get_args(kind))
        if not isinstance(value, list | tuple) or len(value) != n:
            raise SceneError(f"{where} must be a list of {n} numbers, got {value!r}")
        return tuple(number(f"{where}[{i}]", v) for i, v in enumerate(value))
    if kind is int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise SceneError(f"{where} must be a whole number, got {value!r}")
        return value
    return number(where, value)
