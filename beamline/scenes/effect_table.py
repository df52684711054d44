"""Effects of the simulation with their parameters, in the words of their docstrings."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields
from typing import Any

from simulators.effects.catalogue import CATALOGUE, load_effect

_WIDTH, _INDENT = 110, 6  # characters


def effects_text() -> str:
    """Each effect that a scene may name, in the order of physics: what it acts on, what happens, and its parameters
    with their defaults, units and meaning. This imports all of them."""
    lines = []
    for name, row in sorted(CATALOGUE.items(), key=lambda item: item[1].domain):
        lines.append(f"{name}  ({row.domain.words}): {row.summary}")
        for key, default, meaning in parameters(load_effect(name)):
            text = f"{key}{f' = {default}' if default else ', to be given'}: {meaning}"
            lines += textwrap.wrap(text, _WIDTH, initial_indent="    ", subsequent_indent=" " * _INDENT)
    return "\n".join(lines)


def parameters(effect: type[Any]) -> Iterator[tuple[str, str, str]]:
    """Name, default ("" where it must be given) and meaning of each parameter of an effect."""
    meanings = _meanings(effect)
    for field in fields(effect):
        if field.init:
            yield field.name, _default(field), meanings.get(field.name, "")


def _default(field: Field[Any]) -> str:
    value = field.default if field.default_factory is MISSING else field.default_factory()
    if value is MISSING:
        return ""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return str(list(value)) if isinstance(value, tuple) else f"{value:g}" if isinstance(value, float) else str(value)


def _meanings(effect: type[Any]) -> dict[str, str]:
    """The section `Attributes` of a docstring by name; a line may describe several, and go on in the next one."""
    known, meanings, names = {field.name for field in fields(effect)}, dict[str, str](), tuple[str, ...]()
    _, _, section = (inspect.getdoc(effect) or "").partition("\nAttributes:\n")
    for line in map(str.strip, section.splitlines()):
        head, colon, rest = line.partition(": ")
        named = tuple(name.strip() for name in head.split(","))
        if colon and known.issuperset(named):
            names = named
            meanings |= dict.fromkeys(names, rest)
        else:
            meanings |= {name: f"{meanings[name]} {line}".strip() for name in names}
    return meanings
