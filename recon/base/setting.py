"""Setting: declares the meaning, unit and legal range of a value, next to its type and default.

    exposure: Annotated[float, Setting("Of a view.", unit="s", gt=0, le=1e6)] = 0.1

Methods, driver settings, checks, scenes and configurations declare their fields in this way. Functions declare their
arguments in the same way. `recon.base.declared_types` and `CheckedSettings` raise an error if a value does not match
its declaration. pydantic uses the declarations to read a file and to make its schema.
"""

from __future__ import annotations

import dataclasses
import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Annotated, Any

_FACTORS = {**dict.fromkeys(("deg", "deg_s", "deg_s2"), math.radians(1)), "mb": 1e6}
"""Factor from a unit in a configuration to the unit inside the program (radians, bytes)."""


@dataclass(frozen=True)
class Setting:
    """Declaration of the value of a field or an argument.

    Attributes:
        default: default in the unit of a configuration. If it is `...`, or MISSING of dataclasses, the value is
            required.
        doc: meaning of the value, if the name does not say it.
        unit: unit of the value in a configuration; the key ends in the unit's name. "": no unit. Default and bounds are
            in this unit.
        gt, ge, lt, le: bounds of a number; a number must be finite.
        min_length, max_length: bounds for the length of a text or a list.
        pattern: regular expression that a text must match.
        problem: function that returns what is wrong with a value, or "" if the value is right. None: no further check.
    """

    doc: str = ""
    default: Any = ...
    unit: str = ""
    gt: float | None = None
    ge: float | None = None
    lt: float | None = None
    le: float | None = None
    min_length: int | None = None
    max_length: int | None = None
    pattern: str | None = None
    problem: Callable[[Any], str] | None = None

    @property
    def bounds(self) -> Mapping[str, Any]:
        """The bounds that were given, by name."""
        return {name: bound for name in _WITHIN if (bound := getattr(self, name)) is not None}

    @property
    def words(self) -> str:
        """The bounds as text, such as `> 0 and <= 5`, for messages about configurations, options and arguments."""
        return self._text(self.bounds)

    @staticmethod
    def _text(bounds: Mapping[str, Any]) -> str:
        shown = {name: f"{each:g}" if isinstance(each, float) else each for name, each in bounds.items()}
        return " and ".join(f"{_WORDS[name]} {each}" for name, each in shown.items())

    def fault(self, value: Any) -> str:
        """What is wrong with the value of a field; "" if the value is right."""
        if isinstance(value, Real) and not -math.inf < float(value) < math.inf:
            return "expected a finite number"
        if value is None:
            return ""
        bounds = {name: self.inside(bound) for name, bound in self.bounds.items()}
        if not all(_WITHIN[name](value, bound) for name, bound in bounds.items()):
            return f"expected {self._text(bounds)}"
        return "" if self.problem is None else self.problem(value)

    def key_of(self, field: str) -> str:
        """The key of a field in a configuration."""
        return f"{field}_{self.unit}" if self.unit else field

    def inside(self, value: Any) -> Any:
        """A value of a configuration, converted to the unit of the field."""
        if value is None or self.unit not in _FACTORS:
            return value
        return value * 1_000_000 if self.unit == "mb" else math.radians(value)

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        """The schema of the type with these bounds; also for a type that allows None."""
        schema = handler(source)
        (schema["schema"] if schema["type"] == "nullable" else schema).update(self.bounds)
        if self.problem is None:
            return schema
        from pydantic_core import core_schema  # imported here, because only reading a file needs it

        return core_schema.no_info_after_validator_function(self._checked, schema)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Callable[[Any], Any]) -> Any:
        return handler(schema) | ({"description": self.doc} if self.doc else {})

    def _checked(self, value: Any) -> Any:
        if value is not None and self.problem is not None and (problem := self.problem(value)):
            raise ValueError(problem)
        return value


_WITHIN: Mapping[str, Callable[[Any, Any], Any]] = {
    "gt": operator.gt,
    "ge": operator.ge,
    "lt": operator.lt,
    "le": operator.le,
    "min_length": lambda value, least: len(value) >= least,
    "max_length": lambda value, most: len(value) <= most,
    "pattern": lambda text, pattern: re.fullmatch(pattern, text),
}
_WORDS = {
    "gt": ">", "ge": ">=", "lt": "<", "le": "<=", "min_length": "a length of at least",
    "max_length": "a length of at most", "pattern": "text of the form",
}  # fmt: skip
_SETTING = "setting"  # key in the metadata of a field

Natural = Annotated[int, Setting(ge=0)]
Count = Annotated[int, Setting(ge=1)]
NonNegative = Annotated[float, Setting(ge=0)]
Positive = Annotated[float, Setting(gt=0)]


def setting(default: Any = ..., doc: str = "", **rest: Any) -> Any:
    """A field, with its declaration, of a dataclass or of a section of a configuration. `rest` are the arguments of
    `Setting`."""
    made = Setting(doc, default, **rest)
    inside = dataclasses.MISSING if default is ... else made.inside(default)
    return dataclasses.field(default=inside, metadata={_SETTING: made, "description": doc or None, **made.bounds})


def settings_of(owner: Any) -> Mapping[str, Setting]:
    """The declarations of the fields of a dataclass, by name."""
    return {each.name: each.metadata.get(_SETTING, Setting(default=each.default)) for each in dataclasses.fields(owner)}


class CheckedSettings:
    """Base class of settings (dataclasses) that checks the bounds of all fields.

    Raises:
        ValueError: a field is out of its bounds.
    """

    def __post_init__(self) -> None:
        for name, declared in settings_of(self).items():
            if fault := declared.fault(value := getattr(self, name)):
                raise ValueError(f"{type(self).__name__}.{name} is {value!r}: {fault}")
