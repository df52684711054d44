"""Section: a frozen group of configuration keys, some of them declared by a driver's settings with `key`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, create_model, model_validator

from drivers.flat import FlatField, Key, flat_fields, from_flat


def without(problem_of: Callable[[str], str]) -> AfterValidator:
    """A validator that refuses a text for which `problem_of` returns a problem."""

    def checked(text: str) -> str:
        if problem := problem_of(text):
            raise ValueError(problem)
        return text

    return AfterValidator(checked)


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


def declared(settings: type[Any]) -> dict[str, Any]:
    """Type and default of each key by name, for `section_of`."""
    return {_name(field): _declared(field) for field in flat_fields(settings)}


def read_from(section: Section, settings: type[Any]) -> Any:
    """The driver's settings from a section with the same keys."""
    return from_flat(
        settings, {field.name: _inside(field, getattr(section, _name(field))) for field in flat_fields(settings)}
    )


def _key(field: FlatField) -> Key:
    declared_key = field.metadata["key"]
    assert isinstance(declared_key, Key)
    return declared_key


def _name(field: FlatField) -> str:
    return _key(field).name_of(field.name)


def _inside(field: FlatField, value: Any) -> Any:
    """A key's value for the driver, in the unit and of the type of the field."""
    if value is None or _key(field).converted:
        return _key(field).inside(value)
    return field.plain(value) if _is(field.plain, StrEnum, Path) else value


def _is(plain: Any, *kinds: type[Any]) -> bool:
    """Whether it is a class of one of these kinds, and not a union."""
    return isinstance(plain, type) and issubclass(plain, kinds)


def _declared(field: FlatField) -> tuple[Any, Any]:
    """Type and default of a field's key, as pydantic takes them."""
    key, plain = _key(field), field.plain
    legal: Any = plain
    if _is(plain, StrEnum):
        legal = Literal[tuple(choice.value for choice in plain)]
    elif _is(plain, Path):
        legal = str
    if key.problem is not None:
        legal = Annotated[legal, without(key.problem)]
    if key.bounds:
        legal = Annotated[legal, Field(**key.bounds)]
    if field.optional:
        legal = legal | None
    default = field.default
    if default is MISSING:
        default = ...
    elif key.converted:
        default = key.default
    elif isinstance(default, StrEnum):
        default = default.value
    return legal, Field(default, description=key.doc or None)


def section_of(name: str, base: type[Section], keys: Mapping[str, Any], doc: str | None = None) -> Any:
    """A section with further keys, (type, default) each, as pydantic.create_model takes a field."""
    return create_model(name, __base__=base, __doc__=doc, **keys)
