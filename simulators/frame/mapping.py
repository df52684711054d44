"""Reads a scene's YAML mapping into frozen dataclasses; an error names the path of the wrong key."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from recon.base.findings import faults_of
from recon.base.registry import unknown
from recon.base.setting import Setting

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")

# Types of fields with bounds; `build` refuses other values.
Positive = Annotated[float, Setting(gt=0)]
NotNegative = Annotated[float, Setting(ge=0)]
Share = Annotated[float, Setting(ge=0, le=1)]
BelowOne = Annotated[float, Setting(ge=0, lt=1)]
Whole = Annotated[int, Setting(ge=0)]


_UNKNOWN = "unexpected_keyword_argument"  # reported first, because a missing key may be one with a wrong name


class SceneError(ValueError):
    """A scene's mapping is wrong; the message names the path of the key, its value and the legal values."""


def build(cls: type[T], where: str, mapping: Any) -> T:
    """`cls(**mapping)` for a dataclass of numbers, text, booleans, tuples and mappings of these, dataclasses of such
    fields, and None if a field is optional. An annotated type may have bounds.

    A number is finite and may be given as text: YAML 1.1 reads 1e5 and 1.0e5 (no sign) as text.

    Raises:
        SceneError: an unknown or missing key, or a wrong value; its path begins with `where`.
    """
    values = dict(mapping) if isinstance(mapping, Mapping) else mapping
    try:
        return _adapter(cls).validate_python(values)
    except ValidationError as error:
        findings = sorted(error.errors(include_url=False), key=lambda each: each["type"] != _UNKNOWN)
        raise SceneError(faults_of(findings, values, _adapter(cls).json_schema(), where)[0].sentence) from None


def named(where: str, legal: Sequence[str], entry: Any) -> tuple[str, Mapping[str, Any]]:
    """The kind that an entry names, and the other keys of the entry. An entry is a bare name, or a mapping with a
    `kind`."""
    kind = entry.get("kind") if isinstance(entry, Mapping) else entry
    if not isinstance(kind, str) or kind not in legal:
        raise SceneError(f"{where}: {unknown('kind', kind, legal)}")
    rest = {key: value for key, value in entry.items() if key != "kind"} if isinstance(entry, Mapping) else {}
    return kind, rest


def choose(where: str, choices: Mapping[str, type[Any]], entry: Any) -> Any:
    """The dataclass that an entry names, built from the other keys."""
    kind, rest = named(where, list(choices), entry)
    return build(choices[kind], f"{where} ({kind})", rest)


@contextmanager
def located(where: str) -> Iterator[None]:
    """Turn a ValueError of the block into a SceneError at this path; a SceneError keeps its own path."""
    try:
        yield
    except SceneError:
        raise
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from None


@cache
def _adapter(cls: type[T]) -> TypeAdapter[T]:
    for each in _dataclasses(cls):
        each.__pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)
    return TypeAdapter(cls)


def _dataclasses(kind: Any) -> Iterator[Any]:
    """A dataclass and the dataclasses of its fields, also inside types that are made of others."""
    parts = get_type_hints(kind).values() if is_dataclass(kind) else get_args(kind)
    yield from (kind,) if is_dataclass(kind) else ()
    for part in parts:
        yield from _dataclasses(part)
