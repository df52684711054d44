"""Commands are tested as from a terminal, wherever the tests themselves run."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def terminal() -> Iterator[None]:
    """A hang-up ends things: under nohup it is ignored, and commands respect that."""
    if sys.platform == "win32":
        yield
        return
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)
