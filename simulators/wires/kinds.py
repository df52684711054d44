"""Kinds of simulated devices by name, with options as text: "pm16c?channel=3&counts_per_turn=360000".

An option is any keyword argument of the device's class that is a number, a text, or true or false. Classes are
imported when they are first asked for.
"""

from __future__ import annotations

import importlib
import inspect
import types
import typing
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qsl

from drivers.clock import Clock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.wire import Wire

KINDS = {
    "pm16c": "simulators.wires.pm16c.wire:PM16CController",
    "pi_gcs": "simulators.wires.pi_gcs.wire:PiGcsController",
    "zaber": "simulators.wires.zaber.wire:ZaberController",
}
"""Name -> module and class; the class takes a clock, a trigger line and keyword arguments."""


def stand_alone(name: str, clock: Clock) -> Wire:
    """A device with a trigger line of its own; `name` is a kind, and after a "?" its options.

    Raises:
        ValueError: there is no such kind or option, or a value that the option cannot have.
    """
    kind, _, query = name.partition("?")
    if kind not in KINDS:
        raise ValueError(f"there is no simulated device {kind!r}; there are {', '.join(sorted(KINDS))}")
    module, _, attribute = KINDS[kind].partition(":")
    make = getattr(importlib.import_module(module), attribute)
    readers = _readers(make)
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
        wire: Wire = make(clock, TriggerLine(clock), **options)
    except (ArithmeticError, LookupError, ValueError) as problem:
        raise ValueError(f"{name} cannot be made: {problem!r}") from problem
    return wire


def _readers(make: Callable[..., Any]) -> dict[str, Callable[[str], Any]]:
    """Option -> how its text is read."""
    initialise = make.__init__ if inspect.isclass(make) else make
    hints = typing.get_type_hints(initialise)
    readers: dict[str, Callable[[str], Any]] = {}
    for option, parameter in inspect.signature(initialise).parameters.items():
        hint = hints.get(option)
        choices = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
        plain = [choice for choice in choices if choice is not types.NoneType]
        if parameter.kind is parameter.KEYWORD_ONLY and len(plain) == 1 and plain[0] in _READERS:
            read = _READERS[plain[0]]
            readers[option] = _or_none(read) if types.NoneType in choices else read
    return readers


def _truth(text: str) -> bool:
    try:
        return {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}[text.lower()]
    except KeyError:
        raise ValueError("it is true or false") from None


def _or_none(read: Callable[[str], Any]) -> Callable[[str], Any]:
    return lambda text: None if text.lower() == "none" else read(text)


_READERS: dict[type, Callable[[str], Any]] = {int: int, float: float, str: str, bool: _truth}
