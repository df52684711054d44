"""The registry of simulated controllers, and one of them by text: "pm16c?channel=3&counts_per_turn=360000".

An option is any field of the controller's build, or of a value in it, that is a number, a text, a choice, or true or
false.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from importlib import import_module
from typing import Any
from urllib.parse import parse_qsl

from drivers.clock import Clock
from drivers.flat import FlatField, flat_fields, from_flat
from drivers.plugins import plugins
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.wire import Build, Controller

REGISTRY = {  # kind, as in `drivers.stages.registry`: class in the kind's module `wire`
    "pm16c": "PM16CBuild",
    "pi_gcs": "PiGcsBuild",
    "zaber": "ZaberBuild",
}
WIRES: dict[str, type[Build]] = {
    **{kind: getattr(import_module(f"simulators.wires.{kind}.wire"), name) for kind, name in REGISTRY.items()},
    **plugins("wire", REGISTRY),
}
"""Kind -> how its simulated controller is built."""


def stand_alone(name: str, clock: Clock) -> Controller:
    """A controller with a trigger line of its own; `name` is a kind, and after a "?" its options.

    Raises:
        ValueError: there is no such kind or option, or a value that the option cannot have.
    """
    kind, _, query = name.partition("?")
    if kind not in WIRES:
        raise ValueError(f"there is no simulated device {kind!r}; there are {', '.join(sorted(WIRES))}")
    readers = {field.name: read for field in flat_fields(WIRES[kind]) if (read := _reader(field)) is not None}
    options: dict[str, Any] = {}
    for option, text in parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query)):
        if option not in readers:
            raise ValueError(f"{kind} has no option {option!r}; it has {', '.join(sorted(readers))}")
        if option in options:
            raise ValueError(f"{kind} has the option {option!r} twice")
        try:
            options[option] = readers[option](text)
        except ValueError as problem:
            raise ValueError(f"{option}={text} of {kind} cannot be read: {problem}") from problem
    try:
        return from_flat(WIRES[kind], options).controller(clock, TriggerLine(clock))
    except (ArithmeticError, LookupError, ValueError) as problem:
        raise ValueError(f"{name} cannot be built: {problem!r}") from problem


def _reader(field: FlatField) -> Callable[[str], Any] | None:
    """How an option is read from text; None for a field that is no option."""
    plain = field.plain
    if not isinstance(plain, type) or not (plain in (int, float, str, bool) or issubclass(plain, StrEnum)):
        return None
    read = _truth if plain is bool else plain
    return (lambda text: None if text.lower() == "none" else read(text)) if field.optional else read


def _truth(text: str) -> bool:
    try:
        return {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}[text.lower()]
    except KeyError:
        raise ValueError("it is true or false") from None
