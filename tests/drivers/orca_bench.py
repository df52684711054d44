"""An ORCA-Quest, real or simulated, for the conformance suite of the package."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from drivers.base.clock import Clock
from drivers.base.protocols import Camera, CameraSettings, TriggerSource
from drivers.testing.camera import CameraBench

SETTINGS = CameraSettings(exposure=0.01, trigger=TriggerSource.EXTERNAL, roi=(1120, 2008, 48, 64))
REFUSED = (
    ({"roi": (1120, 2008, 47, 64)}, "steps of 4"),
    ({"roi": (2300, 2008, 48, 64)}, "extends beyond the sensor"),
    ({"binning": 3}, "legal: 1, 2, 4"),
    ({"exposure": 1e-9}, "1800 s"),
    ({"exposure": 1e5}, "1800 s"),
    ({"readout": "loud"}, "legal: standard, ultra_quiet"),
)


def orca_bench(camera: Camera, clock: Clock, pulse: Callable[[Sequence[float]], None]) -> CameraBench:
    return CameraBench(camera, clock, pulse, SETTINGS, REFUSED, binnings=(2, 4))


def says_what_an_orca_says(bench: CameraBench) -> None:
    """Its conversion is that of an ORCA-Quest: electrons a count, and counts."""
    bench.camera.configure(SETTINGS)
    text = bench.camera.describe()
    assert 0.05 < float(text["conversion_factor"]) < 0.2
    assert 50 < float(text["conversion_offset"]) < 500
