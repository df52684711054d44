"""What a live reconstruction costs the scan beside it, the rate of acquisition with and without one, in turn; and how
soon a view that is in the file is in the model.

Run with  pytest -m bench -s tests/bench/test_live_rate.py ; a few minutes. 256 x 256 pixels, up to 200 000 Gaussians.
One scan is as fast as this machine simulates and writes frames, so that both want all its processors, which no camera
does; the other has a period, as a scan has.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.config.load import load
from beamline.core.events import Event
from beamline.core.stop import StopRequest
from beamline.monitor.digest import digest
from beamline.projections.selection import Selection
from beamline.reconstruct.live_fit import ScanFollower
from beamline.reconstruct.options import FollowTiming, OutputPaths, ReconOptions
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.scan.live_process import follow_command
from beamline.scan.run import run_scan
from beamline.storage.readers.open import SourceOptions
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame, FrameKind
from recon.splatting import optimise
from recon.splatting.r2 import R2
from recon.warm_up import warm_up
from tests.bench.test_anytime_curve import slab

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


class ProcessorClock:
    """Seconds of one processor that is all ours, whatever else the machine does: waiting takes no time, and what is due
    by then happens in none, as it would in the process of the scan."""

    def __init__(self) -> None:
        self._off = 0.0
        self.due: list[tuple[float, Callable[[], None]]] = []

    def now(self) -> float:
        now = time.process_time() + self._off
        while self.due and self.due[0][0] <= now:
            begin = time.process_time()
            self.due.pop(0)[1]()
            self._off -= time.process_time() - begin
        return now

    def sleep(self, seconds: float) -> None:
        self._off += seconds


def _frames(views: int) -> list[Frame]:
    """Two flats and two darks, then views of 256 x 256 pixels in golden order."""
    data, geometry = slab(256, 256, 20_000, views)
    counts = 100 + 30_000 * np.exp(-2 * data / data.max())
    levels = [(FrameKind.DARK, 100), (FrameKind.DARK, 101), (FrameKind.FLAT, 30_100), (FrameKind.FLAT, 30_101)]
    kinds = [kind for kind, _ in levels] + [FrameKind.PROJECTION] * views
    images = [np.full((256, 256), level) for _, level in levels] + list(counts)
    angles = [math.nan] * len(levels) + geometry.angles.tolist()
    return [
        Frame(image.astype(np.uint16), kind, i, i, i, angle, float(i), 0.1)
        for i, (image, kind, angle) in enumerate(zip(images, kinds, angles, strict=True))
    ]


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(("views", "period"), [(90, 1.0)])
def test_a_view_is_in_the_model_within_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, views: int, period: float
) -> None:
    """From the frame in the file to the end of the first step that learns its view, by `recon --follow` as it is, with
    snapshots and pictures; one processor for it, the other for the scan. 50 000 Gaussians at the first placement."""
    warm_up()
    clock, path, learnt, placed = ProcessorClock(), tmp_path / "scan.h5", dict[int, float](), list[Any]()
    writer = NXtomoWriter(path, ScanInfo("slab", axis_col=127.5, plan=""), (256, 256), clock=SystemClock())
    frames, begin, step = _frames(views), clock.now(), optimise.step
    arrived = {i - 4: begin + period * i for i in range(4, len(frames))}

    def append(frame: Frame) -> Callable[[], None]:
        return lambda: writer.append(frame, digest(frame.counts), [])

    clock.due = [(begin + period * i, append(frame)) for i, frame in enumerate(frames)]
    clock.due.append((begin + period * len(frames), lambda: writer.close("complete")))

    def spy(state: Any, problem: Any, settings: Any, fraction: float, view: int | None = None) -> Any:
        found = step(state, problem, settings, fraction, view)
        if problem.geometry.detector_shape != (256, 256):  # it compiles
            return found
        known = [] if view is None else [view]
        if not any(state is one for one in placed):  # a placement learns all views that are there
            placed.append(state)
            known = list(range(problem.geometry.n_views))
        for one in known:
            learnt.setdefault(one, clock.now())
        return found

    def end(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(optimise, "step", spy)
    monkeypatch.setattr(ScanFollower, "catch_up", end)
    method = R2(gaussians=50_000, seconds=1.0)
    target, timing = OutputPaths(tmp_path / "recon.h5", None), FollowTiming()
    options = ReconOptions(SourceOptions(path), target, Selection(), method, follow=timing)
    said = list[Event]()
    with pytest.raises(KeyboardInterrupt):
        reconstruct_file(options, said.append, clock)
    first = min(learnt.values())
    late = np.array([learnt.get(view, math.inf) - at for view, at in arrived.items() if at > first - period])
    steps = [event.data for event in said if event.event == "progress" and "step" in event.data][-1]
    shots = sum(event.event == "snapshot" for event in said)
    print(
        f"\n{late.size} of {views} views, {period} s apart, came to a model: median {np.median(late):.2f} s, p95 "
        f"{np.percentile(late, 95):.2f} s, largest {late.max():.2f} s; {steps['step']} steps, "
        f"{steps['n_gaussians']} Gaussians, {shots} snapshots"
    )
    assert np.percentile(late, 95) <= 1
