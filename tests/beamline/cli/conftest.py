"""Commands behave as in a terminal, also if the tests run without one."""

import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.beamline.cli.small_scan import SCAN
from tests.beamline.scans import write_exchange


@pytest.fixture(autouse=True)
def terminal() -> Iterator[None]:
    """Restore the signals that end programs. Under nohup or in the background they are ignored, which commands
    respect."""
    if sys.platform == "win32":
        yield
        return
    before = [(number, signal.signal(number, signal.SIG_DFL)) for number in (signal.SIGHUP, signal.SIGQUIT)]
    yield
    for number, handler in before:
        signal.signal(number, handler)


@pytest.fixture
def no_debug(monkeypatch: pytest.MonkeyPatch) -> None:
    """A defect ends a command in the way that its user sees."""
    monkeypatch.delenv("BEAMLINE_DEBUG", raising=False)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, which contains a valid scan."""
    monkeypatch.chdir(tmp_path)
    write_exchange(tmp_path / "scan.h5", SCAN)
    return tmp_path
