"""Section: a frozen group of configuration keys, some of them declared by a driver's settings."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING
from enum import StrEnum
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict, create_model, model_validator

from recon.base.setting import Setting, settings_of

_types: Callable[..., Mapping[str, Any]] = cache(get_type_hints)


def port_problem(port: str) -> str:
    """The fault of a port; "" if it is possible. The name of a port (unlike a URL) has a colon only within a path."""
    wrong = re.match(r"[a-z]\w*:(?!//)|socket://(?!.+:\d+)", port, re.IGNORECASE)
    return f"{port} is not a port; expected a port such as COM3, /dev/ttyUSB0 or socket://host:7777" if wrong else ""


SEVERAL_LINES = ("description", "pattern", "query", "line_end")  # keys whose text may have control characters
Port = Annotated[str, Setting(min_length=1, problem=port_problem)]


class Section(BaseModel):
    """A frozen group of keys. It does not accept unknown keys, or `yes` for a number.

    If a validator of a group raises an error, its message must begin with the key that has the fault. The line of this
    key is then added to the message.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _refuse_yaml_traps(cls, data: Any) -> Any:
        """Raise an error for values that YAML probably reads differently from what the author meant."""
        for name, field in cls.model_fields.items() if isinstance(data, dict) else ():
            truths, value = (field.annotation, *get_args(field.annotation)), data.get(name)
            if isinstance(value, bool) and bool not in truths:
                raise ValueError(f"{name} is {str(value).lower()} (YAML reads yes, no, on and off as true and false)")
            if isinstance(value, str) and name not in SEVERAL_LINES and (lowest := min(value, default=" ")) < " ":
                raise ValueError(
                    f"{name} is {value!r}, with the control character {lowest!r}. In double quotes a backslash "
                    "starts a control character; write the text without quotes, or in single quotes"
                )
        return data


def declared(settings: type[Any]) -> dict[str, Any]:
    """Type and default of the key for each field of a driver's settings, for `section_of`."""
    types = _types(settings)
    return {setting.key_of(name): _declared(setting, types[name]) for name, setting in settings_of(settings).items()}


def read_from(section: Section, settings: type[Any]) -> Any:
    """The driver's settings from a section with the same keys."""
    types, own_settings = _types(settings), settings_of(settings).items()
    return settings(
        **{
            name: _inside(setting, types[name], getattr(section, setting.key_of(name)))
            for name, setting in own_settings
        }
    )


def _inside(setting: Setting, kind: Any, value: Any) -> Any:
    """The value of a key for the driver, converted to the unit and type of the field."""
    cast = next((each for each in (kind, *get_args(kind)) if _is(each, StrEnum, Path)), None)
    return setting.inside(value) if cast is None or value is None else cast(value)


def _is(kind: Any, *kinds: type[Any]) -> bool:
    """True if the type is a single class (not a union) that derives from one of these classes."""
    return isinstance(kind, type) and issubclass(kind, kinds)


def _declared(setting: Setting, kind: Any) -> tuple[Any, Any]:
    """Type and default of the key of a field, in the form that pydantic needs."""
    members = (
        Literal[tuple(choice.value for choice in each)] if _is(each, StrEnum) else str if _is(each, Path) else each
        for each in (get_args(kind) if get_origin(kind) is UnionType else (kind,))
    )
    default = setting.default.value if isinstance(setting.default, StrEnum) else setting.default
    return Annotated[Union[tuple(members)], setting], ... if default is MISSING else default  # noqa: UP007


def section_of(name: str, base: type[Section], keys: Mapping[str, Any], doc: str | None = None) -> Any:
    """A section with further keys. Each key is given as (type, default), like a field for pydantic.create_model."""
    return create_model(name, __base__=base, __doc__=doc, **keys)
