"""Dialogues with a simulated controller, in the form in which a person at a terminal would see them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any, Protocol

import pytest

MACROS = "train", "window"


class Host(Protocol):
    """A host that talks raw commands on a virtual clock."""

    clock: Any

    def tell(self, *commands: str) -> None: ...

    def ask(self, *commands: str) -> str: ...

    def rest(self) -> None:
        """Let an hour pass."""

    def pulses(self) -> Sequence[object]: ...

    def places(self) -> Sequence[float]:
        """Where the pulses were."""

    def at(self, time: float) -> float:
        """Where the stage was."""


def played(dialogues: Mapping[str, tuple[dict[str, Any], str]]) -> pytest.MarkDecorator:
    """A test for each dialogue: what the controller is built with, and what is said."""
    return pytest.mark.parametrize(("build", "said"), dialogues.values(), ids=dialogues)


def play(host: Host, said: str) -> None:
    """Say one command after the other.

    `COMMAND -> REPLY`: it is answered so, which may have *, and / for the end of a line within. `~ S`: seconds pass,
    an hour without a number. `@ 2 3`: all pulses until now were there; `# N`: there were so many. `at S -> PLACE`: the
    stage was there. `train` and `window` are those of the host, with their numbers.
    """
    for step in filter(None, (each.strip() for each in said.split(";"))):
        command, answered, reply = step.partition(" -> ")
        word, *rest = command.split()
        if word == "at":
            assert host.at(float(rest[0])) == pytest.approx(float(reply)), step
        elif answered:
            heard = host.ask(command).replace("\n", "/")
            assert fnmatchcase(heard, reply), f"{step}: {heard}"
        elif word == "~":
            host.clock.sleep(float(rest[0])) if rest else host.rest()
        elif word == "@":
            assert list(host.places()) == [float(place) for place in rest], step
        elif word == "#":
            assert len(host.pulses()) == int(rest[0]), step
        elif word in MACROS:
            getattr(host, word)(*rest)
        else:
            host.tell(command)
