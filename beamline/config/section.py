"""Section: a frozen group of configuration keys, some of them declared by a driver's settings with `key`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields
from enum import StrEnum
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, create_model, model_validator

from drivers.keys import Key


def without(problem_of: Callable[[str], str]) -> AfterValidator:
    """A validator that refuses a text for which `problem_of` returns a problem."""

    def checked(text: str) -> str:
        if problem := problem_of(text):
            raise ValueError(problem)
        return text

    return AfterValidator(checked)


def port_problem(port: str) -> str:
    """What is wrong with a port; "" if it may be one. Names of ports, not URLs, have a colon only within a path."""
    wrong = re.match(r"[a-z]\w*:(?!//)|socket://(?!.+:\d+)", port, re.IGNORECASE)
    return f"{port} is no port; expected one such as COM3, /dev/ttyUSB0 or socket://host:7777" if wrong else ""


Port = Annotated[str, Field(min_length=1), without(port_problem)]


class Section(BaseModel):
    """A frozen group of keys, which rejects unknown keys, and `yes` for a number.

    What a validator of a group says begins with the key that is to be looked at, whose line the message then has.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _no_truth_for_numbers(cls, data: Any) -> Any:
        for name, field in cls.model_fields.items():
            truths = field.annotation, *get_args(field.annotation)
            if isinstance(data, dict) and isinstance(data.get(name), bool) and bool not in truths:
                value = str(data[name]).lower()
                raise ValueError(f"{name} is {value} (YAML reads yes, no, on and off as true and false)")
        return data


def _keys(settings: type[Any]) -> Iterator[tuple[str, Key]]:
    """The fields of a driver's settings with their keys."""
    return ((field.name, field.metadata["key"]) for field in fields(settings))


def declared(settings: type[Any]) -> dict[str, Any]:
    """Type and default of each key by name, for `section_of`."""
    types = get_type_hints(settings)
    return {key.name_of(name): _declared(key, types[name]) for name, key in _keys(settings)}


def read_from(section: Section, settings: type[Any]) -> Any:
    """The driver's settings from a section with the same keys."""
    types = get_type_hints(settings)
    values = {name: (key, getattr(section, key.name_of(name))) for name, key in _keys(settings)}
    return settings(**{name: _inside(key, types[name], value) for name, (key, value) in values.items()})


def _inside(key: Key, kind: Any, value: Any) -> Any:
    """A key's value for the driver, in the unit and of the type of the field."""
    made = next((each for each in (kind, *get_args(kind)) if _is(each, StrEnum, Path)), None)
    return key.inside(value) if made is None or value is None else made(value)


def _is(kind: Any, *kinds: type[Any]) -> bool:
    """Whether it is a class of one of these kinds, and not a union."""
    return isinstance(kind, type) and issubclass(kind, kinds)


def _declared(key: Key, kind: Any) -> tuple[Any, Any]:
    """Type and default of a field's key, as pydantic takes them."""
    optional = get_origin(kind) is UnionType and NoneType in get_args(kind)
    legal: Any = Union[tuple(each for each in get_args(kind) if each is not NoneType)] if optional else kind  # noqa: UP007
    if _is(legal, StrEnum):
        legal = Literal[tuple(choice.value for choice in legal)]
    elif _is(legal, Path):
        legal = str
    if key.problem is not None:
        legal = Annotated[legal, without(key.problem)]
    if key.bounds:
        legal = Annotated[legal, Field(**key.bounds)]
    default = ... if key.default is MISSING else key.default
    default = default.value if isinstance(default, StrEnum) else default
    return legal | None if optional else legal, Field(default, description=key.doc or None)


def section_of(name: str, base: type[Section], keys: Mapping[str, Any], doc: str | None = None) -> Any:
    """A section with further keys, (type, default) each, as pydantic.create_model takes a field."""
    return create_model(name, __base__=base, __doc__=doc, **keys)
