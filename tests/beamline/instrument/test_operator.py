"""Ask: a request appears on stderr and waits for Enter; if nobody is at the terminal, it says so."""

import io
import sys

import pytest

from beamline.instrument.connect import ask_operator
from drivers.base.errors import DeviceError


def test_asking_needs_somebody(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    with pytest.raises(DeviceError, match="to ask the operator"):
        ask_operator("Open the beam shutter.")

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stdin", Terminal(""))
    with pytest.raises(DeviceError, match="was not confirmed"):
        ask_operator("Open the beam shutter.")
    monkeypatch.setattr(sys, "stdin", Terminal("\n"))
    ask_operator("Open the beam shutter.")
    captured = capsys.readouterr()
    assert captured.out.strip() == ""  # stdout is for results
    assert "Open the beam shutter. Then press Enter (to stop the scan: Ctrl-C, then Enter)" in captured.err
