"""Rides of tests: the configuration, the ride in this process without a live volume, and what its file holds."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from numpy.typing import NDArray

from beamline.config.load import load_as
from beamline.core.events import Event, Warned
from beamline.core.stop import StopRequest
from splatline_areadetector.config import RideConfig
from splatline_areadetector.ridden import Ride
from splatline_areadetector.ride import opened, ride_scan

WITHIN = 20.0  # s, in which a ride ends after its scan
PLAN = {"from": "plan", "views": 20, "start_deg": 0, "step_deg": 9}


def config_of(folder: Path, url: str, angles: Any = PLAN, **ride: Any) -> RideConfig:
    """The configuration of a ride, read from a file."""
    path = folder / "my.yaml"
    section = {"image": url, "angles": angles, "exposure_s": 0.01, "silence_s": 2.0, **ride}
    values = {"sample": {"name": "s"}, "ride": section, "optics": {"pixel_size_um": 1}, "storage": {"folder": "runs"}}
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    return load_as(RideConfig, path, printed_by="beamline ride --example")


@dataclass
class Told:
    """What a ride said."""

    events: list[Event] = field(default_factory=list)
    before: list[str] = field(default_factory=list)
    error: BaseException | None = None

    @property
    def warnings(self) -> str:
        return " ".join(event.message for event in self.events if isinstance(event, Warned))


def ride_along(
    config: RideConfig, folder: Path, scan: Callable[[StopRequest], None], given: Any = None, scans: int = 1
) -> Told:
    """Ride while `scan` runs in a thread, which begins when the ride waits for it."""
    told, stop, failed, ended = Told(), StopRequest(), list[BaseException](), threading.Event()

    def run() -> None:
        try:
            scan(stop)
            ended.wait(WITHIN)
            stop.stop("the test waits no longer")
        except BaseException as error:
            failed.append(error)
            stop.abort("the test's scan failed")

    thread = threading.Thread(target=run, daemon=True)

    def say(text: str) -> None:
        told.before.append(text)
        if not thread.ident:
            thread.start()

    with ExitStack() as held:
        try:
            stream, guide, counters = opened(config, held)
            ride = Ride(config, stream, guide, counters, given or {}, folder / "runs", stop, say)
            for _ in range(scans):
                ride_scan(ride, [told.events.append], live=False)
        except Exception as error:
            told.error = error
        ended.set()
        if thread.ident:
            thread.join(WITHIN)
    if failed:
        raise failed[0]
    return told


@dataclass(frozen=True, eq=False)
class Stored:
    """The columns of a run's file."""

    counts: NDArray[Any]
    kinds: NDArray[Any]
    ids: NDArray[Any]
    triggers: NDArray[Any]
    degrees: NDArray[Any]
    seconds: NDArray[Any]
    missing: list[int]
    status: str

    def of(self, kind: int) -> NDArray[np.intp]:
        return np.flatnonzero(self.kinds == kind)


def stored(folder: Path) -> list[Stored]:
    """The files of the runs in a folder, oldest first."""
    files = (folder / "runs").glob("*/scan.h5")
    return [_stored(path) for path in sorted(files, key=lambda path: path.stat().st_ctime)]


def _stored(path: Path) -> Stored:
    with h5py.File(path) as file:
        log = file["/entry/frame_log"]
        return Stored(
            file["/entry/instrument/detector/data"][()], log["kind"][()], log["framestamp"][()], log["trigger"][()],
            file["/entry/sample/rotation_angle"][()], file["/entry/instrument/detector/count_time"][()],
            file["/entry/progress/missing_triggers"][()].tolist(), file["/entry/progress/status"][()].decode(),
        )  # fmt: skip
