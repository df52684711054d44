"""Figures are drawn only in tests that look at them, because drawing would take most of the time of a report.

The simulated Zaber controller belongs to the tests; a fixture registers it for its kind.
"""

import base64
from typing import IO

import pytest

_PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGP4DwABAQEAsTj2FAAAAABJRU5ErkJggg=="
)


class BlankCanvas:
    """A canvas that accepts any figure and writes an image of one pixel."""

    def __init__(self, figure: object) -> None:
        pass

    def print_png(self, file: IO[bytes], **_: object) -> None:
        file.write(_PIXEL)


@pytest.fixture
def real_pictures() -> None:
    """For tests of the content of a figure, and one test of each complete report."""


@pytest.fixture(autouse=True)
def _undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "real_pictures" not in request.fixturenames:
        monkeypatch.setattr("beamline.report.figures.canvas", BlankCanvas)


@pytest.fixture
def simulated_zaber(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of scans with the Zaber driver: sim://zaber is a port of the simulated controller."""
    from beamline.instrument.simulated import WIRES
    from drivers.stages.zaber.settings import ZaberSettings
    from tests.simulators.wires.zaber.wire import ZaberBuild

    monkeypatch.setattr(ZaberSettings, "stand_in", "")
    monkeypatch.setattr(WIRES, "_entries", {**WIRES, "zaber": ZaberBuild})
