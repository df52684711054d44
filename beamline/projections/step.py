"""Base of a correction step: options, name, memory, and the record of what the step did.

A step is a frozen dataclass. A field made by `option` is an option in three places: on the command line, in a recipe,
and in Python.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

if TYPE_CHECKING:
    from beamline.storage.recon_record import Value


@runtime_checkable
class NamedStep(Protocol):
    """The part of a step that a selection uses. The protocols in `beamline.projections.protocols` describe what a step
    can do.

    Attributes:
        name: name of the step in events, and its key in `ScanOrigin.done`.
        follows: names of steps that come before it.
    """

    name: ClassVar[str]
    follows: ClassVar[tuple[str, ...]]


@dataclass(frozen=True)
class Option:
    """An option of a step on the command line.

    Attributes:
        name: name of the option, including the dashes.
        help: help text for the user.
        default: the default as one would type it; None: the default is to leave the option out.
        parse: function that converts the typed text to the value of the field. A ValueError means wrong usage.
        choices: what may be typed; empty: anything that `parse` accepts.
        metavar: placeholder of the value in help.
        path: True if the value is the name of a file.
    """

    name: str
    help: str
    default: str | None = None
    parse: Callable[[str], Any] = str
    choices: tuple[str, ...] = ()
    metavar: str | None = None
    path: bool = False


def option(name: str, default: str | None, help: str, **rest: Any) -> Any:
    """A field of a step that the option `name` sets. `rest` are the other attributes of `Option`. Field and option have
    the same default.
    """
    description = Option(name, help, default, **rest)
    return field(default=None if default is None else description.parse(default), metadata={"option": description})


def options_of(step: type[NamedStep]) -> dict[str, Option]:
    """The options of a step, by field."""
    return {each.name: each.metadata["option"] for each in fields(step) if "option" in each.metadata}  # type: ignore[arg-type]


def key_of(option: str) -> str:
    """The key of an option's value in the parameters of a command."""
    return option.lstrip("-").replace("-", "_")


def positive(text: str) -> float:
    """Check that the value is a finite number above 0; raises ValueError otherwise."""
    number = float(text)
    if not 0 < number < math.inf:
        raise ValueError(f"{text} must be above 0")
    return number


@dataclass(frozen=True, eq=False)
class StepDone:
    """What a step did.

    Attributes:
        sentence: a sentence for the user; empty if nothing was requested or found.
        parameters: what the file of the volume records about the step, by name; None: the options of the step, and
            `said`.
        warned: True if the sentence was already given as a warning.
    """

    sentence: str = ""
    parameters: Mapping[str, Value] | None = None
    warned: bool = False


@dataclass(frozen=True)
class StepMemory:
    """Peak memory of a step in bytes, in addition to raw pixels, line integrals and volume.

    Attributes:
        correcting: memory while projections are corrected, one batch at a time.
        alone: memory before or after the correction.
    """

    correcting: int = 0
    alone: int = 0

    @classmethod
    def of_all(cls, steps: Iterable[StepMemory]) -> StepMemory:
        """Memory of all steps, which run one after the other."""
        needs = list(steps)
        return cls(max(need.correcting for need in needs), max(need.alone for need in needs))
