"""Mapping: reads a scene's YAML mapping into frozen dataclasses; an error names the path of its key."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_type_hints

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from recon.base.registry import unknown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from pydantic_core import ErrorDetails

T = TypeVar("T", bound="DataclassInstance")

# Types of fields with bounds; `build` refuses other values.
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
BelowOne = Annotated[float, Field(ge=0, lt=1)]
Whole = Annotated[int, Field(ge=0)]


class SceneError(ValueError):
    """A scene's mapping is wrong; the message names the path of the key, its value and the legal values."""


def build(cls: type[T], where: str, mapping: Any) -> T:
    """`cls(**mapping)` for a dataclass of numbers, text, booleans, tuples and mappings of these, dataclasses of such
    fields, and None where a field is optional. An annotated type may have bounds.

    A number is finite and may be given as text: YAML 1.1 reads 1e5 and 1.0e5 (no sign) as text.

    Raises:
        SceneError: an unknown or missing key, or a wrong value; its path begins with `where`.
    """
    try:
        return _adapter(cls).validate_python(dict(mapping) if isinstance(mapping, Mapping) else mapping)
    except ValidationError as error:
        faults = error.errors(include_url=False)
        first = next((fault for fault in faults if fault["type"] == "unexpected_keyword_argument"), faults[0])
        raise SceneError(_sentence(cls, where, first)) from None


def named(where: str, legal: Sequence[str], entry: Any) -> tuple[str, Mapping[str, Any]]:
    """The kind that an entry names and the rest of its keys: a bare name, or a mapping with a `kind`."""
    kind = entry.get("kind") if isinstance(entry, Mapping) else entry
    if not isinstance(kind, str) or kind not in legal:
        raise SceneError(f"{where}: {unknown('kind', kind, legal)}")
    rest = {key: value for key, value in entry.items() if key != "kind"} if isinstance(entry, Mapping) else {}
    return kind, rest


def choose(where: str, choices: Mapping[str, type[Any]], entry: Any) -> Any:
    """The dataclass that an entry names, built from the rest."""
    kind, rest = named(where, list(choices), entry)
    return build(choices[kind], f"{where} ({kind})", rest)


@contextmanager
def located(where: str) -> Iterator[None]:
    """Turn a ValueError of the block into a SceneError at this path; a SceneError keeps its own."""
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
    """A dataclass and those of its fields; those in a type that is made of others."""
    parts = get_type_hints(kind).values() if is_dataclass(kind) else get_args(kind)
    yield from (kind,) if is_dataclass(kind) else ()
    for part in parts:
        yield from _dataclasses(part)


def _declared_at(cls: Any, loc: Sequence[str | int]) -> Any:
    """The dataclass at a place of the mapping; the outer one where that is in a list."""
    for part in loc:
        inner = [*_dataclasses(get_type_hints(cls)[part])] if isinstance(part, str) else []
        cls = inner[0] if inner else cls
    return cls


_EXPECTED = {
    "float": "a finite number",
    "finite": "a finite number",
    "int": "a whole number",
    "bool": "true or false",
    "string": "text",
    "tuple": "a list",
    "dict": "a mapping",
}
"""By the first word of the type of pydantic's error."""


def _sentence(cls: Any, where: str, error: ErrorDetails) -> str:
    """A sentence from pydantic's error: the path, the expected kind of value, and the value."""
    kind, loc, value = error["type"], error["loc"], error["input"]
    path = where + "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc if part != "[key]")
    if kind == "value_error":
        message = str(error["ctx"]["error"])
        return f"{path} {message}" if message.startswith("must ") else f"{path}: {message}"
    if kind == "dataclass_type":
        legal = ", ".join(field.name for field in fields(_declared_at(cls, loc)))
        return f"{path} must be a mapping with the keys {legal}; got {value!r}"
    if kind == "unexpected_keyword_argument":
        declared = _declared_at(cls, loc[:-1])
        return f"{path.rpartition('.')[0]}: {unknown('key', loc[-1], [field.name for field in fields(declared)])}"
    if kind == "missing":
        *_, last = loc
        return (
            f"{path.removesuffix(f'.{last}')}: key {last!r} is missing"
            if isinstance(last, str)
            else (f"{path} is missing, got {value!r}")
        )
    if kind == "too_long":
        return f"{path} must be a list of {error['ctx']['max_length']}, got {value!r}"
    by_kind = _EXPECTED.get(kind.split("_")[0], error["msg"].removeprefix("Input should be "))
    expected = error["ctx"]["expected"] if kind == "literal_error" else by_kind
    return f"{path}{': key' if '[key]' in loc else ''} must be {expected}, got {value!r}"
