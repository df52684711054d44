"""Mapping: reads a scene's YAML mapping into frozen dataclasses; an error names the path of its key."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from functools import cache, partial
from types import MappingProxyType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    FiniteFloat,
    StrictBool,
    StrictStr,
    TypeAdapter,
    ValidationError,
    create_model,
)

from recon.base.registry import unknown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from pydantic_core import ErrorDetails

T = TypeVar("T", bound="DataclassInstance")
K, V = TypeVar("K"), TypeVar("V")

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
        return _adapter(cls).validate_python(mapping)
    except ValidationError as error:
        raise SceneError(_sentence(where, error.errors(include_url=False)[0])) from None


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


def _no_bool(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError(f"must be a number, got {value}")
    return value


_SCALARS: Mapping[Any, Any] = {
    float: Annotated[FiniteFloat, BeforeValidator(_no_bool)],
    int: Annotated[int, BeforeValidator(_no_bool)],
    bool: StrictBool,
    str: StrictStr,
}
_CONTAINERS: Mapping[Any, Any] = {
    tuple: tuple,
    Mapping: Annotated[dict[K, V], AfterValidator(MappingProxyType)],  # type: ignore[valid-type]
    Union: Union,
    UnionType: Union,
}


@cache
def _adapter(cls: type[T]) -> TypeAdapter[T]:
    return TypeAdapter(_checked(cls))


def _checked(kind: Any) -> Any:
    """A field's type with the rules above, for pydantic."""
    if is_dataclass(kind):
        return _checked_dataclass(kind)
    if get_origin(kind) is Annotated:
        inner, *bounds = get_args(kind)
        return Annotated[(_checked(inner), *bounds)]
    if container := _CONTAINERS.get(get_origin(kind)):
        return container[tuple(_checked(part) for part in get_args(kind))]
    return _SCALARS.get(kind, kind)


def _checked_dataclass(cls: Any) -> Any:
    hints, declared = get_type_hints(cls, include_extras=True), [field for field in fields(cls) if field.init]
    needed = [field.name for field in declared if field.default is MISSING and field.default_factory is MISSING]
    kinds: dict[str, Any] = {field.name: (_checked(hints[field.name]), None) for field in declared}

    def instance(read: BaseModel) -> Any:
        return cls(**{name: getattr(read, name) for name in read.model_fields_set})

    check = BeforeValidator(partial(_check_keys, list(kinds), needed))
    return Annotated[create_model(cls.__name__, **kinds), check, AfterValidator(instance)]


def _check_keys(legal: Sequence[str], needed: Sequence[str], mapping: Any) -> Mapping[str, Any]:
    if not isinstance(mapping, Mapping):
        raise ValueError(f"must be a mapping with the keys {', '.join(legal)}; got {mapping!r}")
    if others := [key for key in mapping if key not in legal]:
        raise ValueError(unknown("key", others[0], legal))
    if missing := [key for key in needed if key not in mapping]:
        raise ValueError(f"key {missing[0]!r} is missing; needed: {', '.join(needed)}")
    return mapping


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


def _sentence(where: str, error: ErrorDetails) -> str:
    """A sentence from pydantic's error: the path, the expected kind of value, and the value."""
    kind, loc, value = error["type"], error["loc"], error["input"]
    path = where + "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc if part != "[key]")
    if kind == "value_error":
        message = str(error["ctx"]["error"])
        return f"{path} {message}" if message.startswith("must ") else f"{path}: {message}"
    if kind == "missing":  # an entry of a tuple; keys are checked before
        return f"{path} is missing, got {value!r}"
    if kind == "too_long":
        return f"{path} must be a list of {error['ctx']['max_length']}, got {value!r}"
    by_kind = _EXPECTED.get(kind.split("_")[0], error["msg"].removeprefix("Input should be "))
    expected = error["ctx"]["expected"] if kind == "literal_error" else by_kind
    return f"{path}{': key' if '[key]' in loc else ''} must be {expected}, got {value!r}"
