"""What a live reconstruction costs the scan beside it: the rate of acquisition with and without one, in turn.

Run with  pytest -m bench -s tests/bench/test_live_rate.py ; a few minutes. 256 x 256 pixels, up to 200 000 Gaussians.
One scan is as fast as this machine simulates and writes frames, so that both want all its processors, which no camera
does; the other has a period, as a scan has.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from beamline.config.load import load
from beamline.core.events import Event
from beamline.core.stop import StopRequest
from beamline.scan.live_process import follow_command
from beamline.scan.run import run_scan

PAIRS = 3
SCAN = (
    "devices.camera.roi=[1024, 1920, 256, 256]", "simulation.scene=scenes/plain.yaml", "recon.seconds=1",
    "optics.axis_col=127.5", "scan.exposure_s=0.02", "scan.darks.count=5", "scan.flats={count: 5, at: start}",
)  # fmt: skip


def _rate(folder: Path, live: bool, settings: tuple[str, ...]) -> tuple[float, int, int, int]:
    """Projections a second, from the first to the last; frames missing; views and Gaussians of the volume by then."""
    config = load(Path("configs/simulated.yaml"), (*SCAN, *settings))
    times, views, gaussians = list[float](), 0, 0

    def sink(event: Event) -> None:
        nonlocal views, gaussians
        if event.event == "frame" and event.data["kind"] == "projection":
            times.append(time.monotonic())
            first.append(event.data["n"])
        if event.event == "progress" and event.data.get("source") == "recon" and not ended:
            views, gaussians = event.data.get("n_views", views), event.data.get("n_gaussians", gaussians)
        if event.event == "scan_done":
            ended.append(True)
            stop.abort()  # the rest of the volume is not of interest

    first, ended, stop = list[int](), list[bool](), StopRequest()
    folder.mkdir()
    result = run_scan(config, folder, [sink], stop, live=follow_command(config) if live else None)
    return (first[-1] - first[0]) / (times[-1] - times[0]), len(result.missing), views, gaussians


@pytest.mark.bench
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("name", "settings", "least"),
    [
        ("as fast as it goes", ("simulation.clock=virtual", "scan.angles.views=1500", "scan.period_s=0.05"), 0.4),
        ("ten a second", ("scan.angles.views=200", "scan.period_s=0.1"), 0.95),
    ],
)
def test_a_live_reconstruction_does_not_slow_the_scan(
    tmp_path: Path, name: str, settings: tuple[str, ...], least: float
) -> None:
    ratios = []
    for pair in range(PAIRS):
        rates = {}
        for live in (False, True) if pair % 2 else (True, False):
            rates[live], missing, views, gaussians = _rate(tmp_path / f"{pair}{live}", live, settings)
            assert missing == 0
            print(f"\n{name}, {'live' if live else 'alone'}: {rates[live]:.2f}/s", end="")
            if live:
                print(f", volume of {views} views, {gaussians} Gaussians by its end", end="")
        ratios.append(rates[True] / rates[False])
    print(f"\n{name}: rate with a live reconstruction / alone: {np.round(ratios, 3)}, median {np.median(ratios):.3f}")
    assert np.median(ratios) > least
