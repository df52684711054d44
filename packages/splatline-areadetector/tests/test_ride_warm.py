"""Live volume of `beamline ride`: its process starts and loads its code while the command waits for the scan."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from fake_ioc import FakeIoc, array_value
from ridden import RideProgram, stored

VIEWS, FPS = 60, 4.0
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600), pytest.mark.usefixtures("loopback")]


def _children(ride: RideProgram) -> list[psutil.Process]:
    """Processes that wait to become a live reconstruction, or are one of these."""
    return [
        child
        for child in psutil.Process(ride.process.pid).children(recursive=True)
        if "beamline.cli.standby" in child.cmdline()
    ]


@pytest.mark.parametrize("warm", [True, pytest.param(False, marks=pytest.mark.long)])
def test_the_process_that_has_warmed_up_makes_the_volume(tmp_path: Path, warm: bool) -> None:
    """One that died meanwhile is replaced."""
    across = np.arange(64) - 32 - 6 * np.cos(np.radians(3 * np.arange(VIEWS)))[:, np.newaxis]
    lines = 100 + 40000 * np.exp(-np.sqrt(np.clip(1 - (across / 16) ** 2, 0, None)))
    for name, light in (("darks", 100), ("flats", 40100)):
        np.save(tmp_path / f"{name}.npy", np.full((2, 32, 64), light, np.uint16))
    given = [word for name in ("darks", "flats") for word in (f"--{name}", str(tmp_path / f"{name}.npy"))]
    angles = {"from": "plan", "views": VIEWS, "start_deg": 0, "step_deg": 3}
    with FakeIoc() as ioc, RideProgram(tmp_path, ioc.url, *given, period_s=1 / FPS, angles=angles) as ride:
        (waiting,) = _children(ride)
        deadline = time.monotonic() + 240
        before = -1.0
        while warm and before != (before := sum(waiting.cpu_times()[:2])):
            assert time.monotonic() < deadline
            time.sleep(10)
        if not warm:
            waiting.kill()
        began = time.monotonic()
        ready = pictured = 0.0
        for i in range(VIEWS):
            ioc.post(array_value(np.broadcast_to(lines[i].astype(np.uint16), (32, 64)).copy(), i + 1))
            time.sleep(max(0.0, began + (i + 1) / FPS - time.monotonic()))
            ready = ready or ("The live reconstruction is ready" in ride.output and time.monotonic() - began) or 0.0
            pictured = pictured or (any(tmp_path.glob("runs/*/*.live.png")) and time.monotonic() - began) or 0.0
        assert [child.pid for child in _children(ride)] == ([waiting.pid] if warm else [])
        assert ride.exit_code() in (0, 7), ride.output
    print(f"ready after {ready:.1f} s, the first slices after {pictured:.1f} s; 0: not within {VIEWS / FPS:g} s")
    assert ready or not warm
    (run,) = (tmp_path / "runs").iterdir()
    assert (run / "recon.h5").is_file() and len(stored(tmp_path)[0].ids) == VIEWS + 4
