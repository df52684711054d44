"""Commands are tested as from a terminal, wherever the tests themselves run."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.beamline.cli.small_scan import SCAN
from tests.beamline.scans import write_exchange


@pytest.fixture(autouse=True)
def terminal() -> Iterator[None]:
    """A hang-up ends things: under nohup it is ignored, and commands respect that."""
    if sys.platform == "win32":
        yield
        return
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with a good scan in it."""
    monkeypatch.chdir(tmp_path)
    write_exchange(tmp_path / "scan.h5", SCAN)
    return tmp_path
