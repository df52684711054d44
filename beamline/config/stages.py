"""Configuration of the rotation stage: one section per kind, with the keys that its settings declare."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, Union

from pydantic import Field, create_model, model_validator

from beamline.config.section import Section
from drivers.flat import FlatField, flat_fields, from_flat
from drivers.stages.registry import STAGES
from drivers.stages.settings import ANGULAR, Key, StageSettings


class StageSection(Section):
    """What every stage has. Real ports: COM3, /dev/ttyUSB0, /dev/serial/by-id/..., socket://host:port."""

    kind: str
    port: Annotated[str, Field(min_length=1)]
    """Where its controller is; sim:// and the kind is its simulated counterpart, which takes all else from here."""

    @model_validator(mode="after")
    def _sensible(self) -> Self:
        low, high = (getattr(self, key) for key in ("low_deg", "high_deg"))
        if not low < high:
            raise ValueError(f"low_deg {low} must lie below high_deg {high}")
        if self.simulated and self.port.lower() != f"sim://{self.kind}":
            raise ValueError(f"port {self.port} is not the simulated counterpart of {self.kind}, sim://{self.kind}")
        _ = self.settings
        return self

    @property
    def simulated(self) -> bool:
        return self.port.lower().startswith("sim://")

    @property
    def settings(self) -> StageSettings:
        """What the driver is opened with."""
        kind = STAGES[self.kind]
        return from_flat(kind, {field.name: _inside(field, getattr(self, _name(field))) for field in flat_fields(kind)})


def _key(field: FlatField) -> Key:
    found = field.metadata["key"]
    assert isinstance(found, Key)
    return found


def _name(field: FlatField) -> str:
    """The key of a field."""
    return _key(field).name_of(field.name)


def _inside(field: FlatField, value: Any) -> Any:
    """A key's value as the driver takes it: radians, and the type of the field."""
    if value is None:
        return None
    if _key(field).unit in ANGULAR:
        return math.radians(value)
    return field.plain(value) if issubclass(field.plain, StrEnum | Path) else value


def _declared(field: FlatField) -> tuple[Any, Any]:
    """Type and default of a field's key, as pydantic takes them."""
    key, plain = _key(field), field.plain
    legal: Any = plain
    if issubclass(plain, StrEnum):
        legal = Literal[tuple(choice.value for choice in plain)]
    elif issubclass(plain, Path):
        legal = str
    if key.bounds:
        legal = Annotated[legal, Field(**key.bounds)]
    if field.optional:
        legal = legal | None
    default = field.default
    if default is MISSING:
        default = ...
    elif key.unit in ANGULAR:
        default = key.default
    elif isinstance(default, StrEnum):
        default = default.value
    return legal, Field(default, description=key.doc or None)


def _section(kind: str, settings: type[StageSettings]) -> type[StageSection]:
    keys: dict[str, Any] = {_name(field): _declared(field) for field in flat_fields(settings)}
    return create_model(
        settings.__name__.replace("Settings", "StageConfig"),
        __base__=StageSection,
        __doc__=(settings.__doc__ or "").partition("\n")[0],
        **({"kind": (Literal[kind], ...)} | keys),
    )


STAGE_SECTIONS: Mapping[str, type[StageSection]] = {kind: _section(kind, settings) for kind, settings in STAGES.items()}
"""Kind -> its section of the configuration."""

if TYPE_CHECKING:
    StageConfig = StageSection
else:
    StageConfig = Union[tuple(STAGE_SECTIONS.values())]  # noqa: UP007 - a union of as many as there are
