"""Helpers for tests of `beamline ride`: its configuration, a run in this process without a live volume, its file."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

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
    return reread(path)


def reread(path: Path) -> RideConfig:
    """The configuration of a ride in a file."""
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
                ride_scan(ride, [told.events.append], live=None)
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
    times: NDArray[Any]
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
        log, detector = file["/entry/frame_log"], file["/entry/instrument/detector"]
        return Stored(
            detector["data"][()], log["kind"][()], log["framestamp"][()], log["trigger"][()],
            file["/entry/sample/rotation_angle"][()], log["time"][()], detector["count_time"][()],
            file["/entry/progress/missing_triggers"][()].tolist(), file["/entry/progress/status"][()].decode(),
        )  # fmt: skip


class RideProgram:
    """`beamline ride` as a program, whose output is in a file. As a context it begins when the ride waits for frames,
    and kills it at its end.

    Args:
        folder: of its configuration, runs and output.
        image: the channel of the images.
        options: of the command.
        program: what Python runs instead.
        ride: settings of the section.
    """

    def __init__(self, folder: Path, image: str, *options: str, program: str = "", **ride: object) -> None:
        section = {"image": image, "exposure_s": 0.01, "silence_s": 20, **ride}
        config = {"sample": {"name": "s"}, "ride": section, "optics": {"pixel_size_um": 1}}
        folder.mkdir(exist_ok=True)
        (folder / "my.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
        words = ["ride", str(folder / "my.yaml"), "-o", str(folder / "runs"), *options]
        begin = ["-c", program] if program else ["-m", "beamline.cli.main"]
        self.folder, self._output = folder, folder / "output.txt"
        with self._output.open("w") as stream:
            self.process = subprocess.Popen([sys.executable, *begin, *words], stdout=stream, stderr=subprocess.STDOUT)

    def __enter__(self) -> Self:
        try:
            return self.wait_for(lambda: "Waiting for the first frame" in self.output)
        except BaseException:
            self.__exit__()
            raise

    def __exit__(self, *error: object) -> None:
        self.process.kill()
        self.process.wait()

    @property
    def output(self) -> str:
        return self._output.read_text(encoding="utf-8")

    def wait_for(self, reached: Callable[[], bool], seconds: float = 400.0) -> Self:
        deadline = time.monotonic() + seconds
        while not reached():
            assert time.monotonic() < deadline and self.process.poll() is None, self.output
            time.sleep(0.1)
        return self

    def frames(self) -> int:
        """In the file so far."""
        for path in (self.folder / "runs").glob("*/scan.h5"):
            with suppress(OSError, KeyError), h5py.File(path, "r", swmr=True) as file:
                return int(file["/entry/progress/frames_committed"][()])
        return 0

    def exit_code(self, seconds: float = 400.0) -> int:
        """Wait for its end, at most so long."""
        return self.process.wait(seconds)
