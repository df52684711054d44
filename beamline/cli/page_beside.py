"""The page of a run, in a process of its own beside the scan."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from beamline.core.events import Event, RunStarted
from beamline.core.process import ChildProcess

LOOK, ACT = "watch", "control"  # Purpose of an address: the first word of its line
ENDS_WITHIN = 3.0  # s


class PageBeside:
    """A sink that serves the page of a run from a process of its own, as long as the context lasts.

    Args:
        say: takes the addresses, a line each. They hold the tokens, so that they belong into no log.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._held = say, ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._held.close()

    def __call__(self, event: Event) -> None:
        if not isinstance(event, RunStarted):
            return
        page = ["watch", str(event.folder), "--control", "--until-stdin-ends"]
        command = [sys.executable, "-m", "beamline.cli.main", *page]
        try:
            nowhere = self._held.enter_context(Path(os.devnull).open("w"))  # noqa: SIM115 - the context closes it
            child = ChildProcess(command, nowhere, self._pass_on, tether=True, behind=True)
            self._held.callback(child.wait, seconds=ENDS_WITHIN)
            self._held.callback(child.let_go)  # first: open pages are told that they end
        except OSError as error:
            self._say(f"There is no page ({error}). The scan is not affected.")

    def _pass_on(self, line: str) -> None:
        what, _, address = line.strip().partition(" ")
        if what in (LOOK, ACT):
            self._say(f"Page, to {what}: {address.strip()}")
