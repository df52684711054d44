"""Ctrl-Z does not suspend a scan, because the stage would continue to turn with an open shutter."""

import os
import signal
import sys

import pytest

from beamline.core.stop import StopRequest, stop_signals


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no Ctrl-Z")
def test_ctrl_z_neither_suspends_nor_stops(capfd: pytest.CaptureFixture[str]) -> None:
    stop = StopRequest()
    with stop_signals(stop):
        os.kill(os.getpid(), signal.SIGTSTP)
    assert not stop.stopping
    assert "Use `beamline pause` to pause the scan" in capfd.readouterr().err
