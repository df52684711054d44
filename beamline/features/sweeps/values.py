"""Swept options: NAME=A:B:STEP or NAME=a,b,c as values, and all their combinations."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal

from beamline.core.text import NUMBER
from recon.base.registry import did_you_mean

MOST = 64
"""Slices of a sheet."""
_AXIS = "center", "centre", "center-of-rotation", "centre-of-rotation", "cor", "rotation-axis"  # to other programs
_SIGNED = rf"[-+]?{NUMBER}"
_RANGE = re.compile(rf"({_SIGNED}):({_SIGNED}):({_SIGNED})")


@dataclass(frozen=True)
class SweptOption:
    """An option and the values to try, as they are typed.

    Attributes:
        name: long name, without dashes.
    """

    name: str
    values: tuple[str, ...]

    @property
    def numbers(self) -> tuple[float, ...]:
        """The values as numbers; empty if some are no numbers."""
        numeric = all(re.fullmatch(_SIGNED, value) for value in self.values)
        return tuple(map(float, self.values)) if numeric else ()


def swept_option(text: str, legal: Collection[str]) -> SweptOption:
    """The option and values of NAME=A:B:STEP or NAME=a,b,c.

    Args:
        legal: long names of options that can be swept; "_" in a name stands for "-".

    Raises:
        ValueError: another name, with the nearest one, or no values.
    """
    name, equals, values = text.partition("=")
    name = name.strip().lstrip("-").replace("_", "-")
    if not equals:
        raise ValueError(f"{text!r} is no option with values; expected NAME=A:B:STEP or NAME=a,b,c")
    if name not in legal:
        near = " (did you mean axis?)" if name in _AXIS else did_you_mean(name, legal)
        raise ValueError(
            f"{name!r} cannot be swept{near}; options of `beamline recon --help-all` under Data, Corrections and "
            "Method can be swept, such as tv-weight, rings or axis"
        )
    tried = _values(name, values)
    if len(tried) < 2:
        one = f"; a single one is `beamline recon --{name} {tried[0]}`" if tried else ""
        raise ValueError(
            f"a sweep takes at least two values, as NAME=A:B:STEP or NAME=a,b,c, and {text!r} has {len(tried)}{one}"
        )
    return SweptOption(name, tried)


def _values(name: str, text: str) -> tuple[str, ...]:
    match = _RANGE.fullmatch(text.strip())
    if match is None:
        return tuple(dict.fromkeys(value for value in (word.strip() for word in text.split(",")) if value))
    first, last, step = map(Decimal, match.groups())
    if step == 0 or (last - first) / step <= 0:
        raise ValueError(f"{name}={text}: a STEP of {step} does not lead from {first} to {last}")
    steps = int((last - first) / step)
    if steps >= MOST:
        raise ValueError(f"{name}={text} has {steps + 1} values, more than {MOST}: give a larger STEP")
    return tuple(f"{first + n * step:f}" for n in range(steps + 1))


def combinations(options: Sequence[SweptOption]) -> list[Mapping[str, str]]:
    """All combinations of values, by name; the last option varies fastest.

    Raises:
        ValueError: not one or two different options, or too many combinations.
    """
    names = [option.name for option in options]
    if not 1 <= len(names) <= 2 or len(set(names)) < len(names):
        raise ValueError(f"{len(names)} options are given ({', '.join(names) or 'none'}); expected one, or two others")
    combined: list[Mapping[str, str]] = [
        dict(zip(names, values, strict=True)) for values in itertools.product(*(option.values for option in options))
    ]
    if len(combined) > MOST:
        raise ValueError(f"{len(combined)} combinations are more than {MOST}: give fewer values")
    return combined
