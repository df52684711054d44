"""Ride: waits for somebody else's scan, records it as one of ours, and begins another file where its numbers do."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from beamline.core.errors import BeamlineError, ConfigError, InstrumentError
from beamline.core.events import Sink
from beamline.core.machine import free_memory
from beamline.core.run_result import RunResult
from beamline.core.stop import ScanAborted, StopRequest
from beamline.instrument.connect import ConnectedDevices
from beamline.scan.ledger import LedgerError
from beamline.scan.live_plan import live_plan
from beamline.scan.live_process import LiveCommand, follow_command
from beamline.scan.measurement import Measurement
from beamline.scan.run import record_scan
from beamline.storage.readers.reference_files import load_images
from drivers.base.clock import SystemClock
from drivers.base.errors import DeviceRefused
from drivers.base.frame import FrameKind
from drivers.base.protocols import Devices
from splatline_areadetector.arrays import ArrayFrame
from splatline_areadetector.config import RideConfig, TomoscanAngles
from splatline_areadetector.guides import EXPOSURE, Guide, guide_of
from splatline_areadetector.losses import Counters
from splatline_areadetector.plan import PlannedBlock, RidePlan, ready_of
from splatline_areadetector.ports import refuse_mistakes
from splatline_areadetector.ridden import SLICE, Images, Journey, RiddenFrames, silence_told
from splatline_areadetector.stream import FrameStream, Refused


class _NotOurs:
    """A device of the scan that is ridden; whoever uses it gets DeviceRefused."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __getattr__(self, attribute: str) -> NoReturn:
        raise DeviceRefused(self.name, "it is operated by the scan that is ridden, not by this program")


@dataclass(frozen=True, eq=False)
class Ride:
    """What a ride goes by, connected.

    Attributes:
        counters: of plugin and camera.
        given: darks and flats from files, where the scan takes none.
        runs: the folder in which each run gets its own.
        say: takes what is said while there is no run.
    """

    config: RideConfig
    stream: FrameStream
    guide: Guide
    counters: Counters
    given: Images
    runs: Path
    stop: StopRequest
    say: Callable[[str], None]


def ride_scan(ride: Ride, sinks: Sequence[Sink], *, live: bool) -> list[RunResult]:
    """Record the next scan of the stream: in a run, or in one for each epoch of its frames' numbers.

    Raises:
        ConfigError: the frames cannot be stored, or no angles follow for them; nothing was recorded.
        LedgerError: frames are missing in one of the files; the last such error, after all of them are closed.
        BeamlineError, DeviceError: as `record_scan`.
    """
    results, lost = list[RunResult](), None
    settings = ride.config.ride
    first_id = settings.first_id
    while True:
        ride.guide.begin(first_id)
        first = wait_for_scan(ride, first_id)
        refuse_mistakes(ride.config, ride.counters, first)
        own = _with_exposure(ride.guide.plan(), ride, first)
        plan = _with_given(own, ride.given, first.window.shape)
        ready = ready_of(ride.config, plan, first, ride.runs)
        command = _follow(ride.config, first, plan) if live else None
        frames: list[RiddenFrames] = []

        by = Journey(ride.stream, ride.guide, own, ride.counters, ride.given, first_id, settings.silence_s)

        def source_of(measurement: Measurement, by: Journey = by, frames: list[Any] = frames) -> RiddenFrames:
            frames.append(RiddenFrames(by, measurement))
            return frames[-1]

        instrument = _instrument()
        try:
            results.append(
                record_scan(
                    ride.config.as_scan,
                    ready,
                    source_of,
                    ride.runs,
                    sinks,
                    ride.stop,
                    instrument=instrument,
                    live=command,
                )
            )
        except LedgerError as error:
            lost = error
        if not (frames and frames[-1].epoch):
            if lost is not None:
                raise lost
            return results
        first_id = None  # numbers of another epoch


def _instrument() -> ConnectedDevices:
    names = ("stage", "camera", "shutter", "sample mover")
    devices: Any = Devices(*map(_NotOurs, names))  # type: ignore[arg-type]
    return ConnectedDevices(devices, SystemClock(), None, lambda: None)


def _follow(config: RideConfig, first: ArrayFrame, plan: RidePlan) -> LiveCommand | None:
    if not config.recon.live:
        return None
    return follow_command(config.as_scan, live_plan(first.window.shape, plan.angles.size, free_memory()))


def wait_for_scan(ride: Ride, first_id: int | None) -> ArrayFrame:
    """The first frame of a scan, which the stream still has; those before it are dropped.

    Raises:
        ScanAborted: a stop was requested.
        ConfigError: the frames cannot be stored.
        InstrumentError: the server does not answer.
    """
    stream, guide, settings = ride.stream, ride.guide, ride.config.ride
    clock = SystemClock()
    since, told = clock.now(), False
    shown = stream.first and f" ({stream.first.window.shape[0]} x {stream.first.window.shape[1]} {stream.first.dtype})"
    ride.say(f"Waiting for the first frame of a scan from {stream.name}{shown or ''}.{_untold_exposure(ride)}")
    while not ride.stop.stopping:
        item = stream.next(SLICE)
        if isinstance(item, Refused):
            raise ConfigError(f"Frames of {stream.name} cannot be stored: {item.why}. Nothing was recorded.")
        if isinstance(item, ArrayFrame):
            since = clock.now()
            if item.is_current:  # it was there before
                continue
            kind = guide.phase(item).kind
            early = kind is FrameKind.PROJECTION and item.unique_id < (first_id or 0)
            if kind is not None and not early:
                stream.put_back(item)
                return item
            if not told:
                told = True
                status = f" ({guide.status})" if guide.status else ""
                ride.say(f"Frames of no scan come{status}: they are not stored.")
        elif clock.now() - since > settings.silence_s:
            since = clock.now()
            if not stream.answers():
                raise InstrumentError(
                    f"{stream.name}: no frame for {settings.silence_s:g} s, and its server does not answer. Nothing "
                    "was recorded."
                )
            ride.say(f"No frame for {settings.silence_s:g} s, the server answers: {silence_told(ride.counters)}.")
    raise ScanAborted(f"Interrupted before the first frame: {ride.stop.reason}. Nothing was recorded.")


def _untold_exposure(ride: Ride) -> str:
    """A sentence after a blank where the scan's first frame will have to tell its exposure; "" where something else
    does."""
    settings, first = ride.config.ride, ride.stream.first
    told = first is None or EXPOSURE in first.attributes or isinstance(settings.angles, TomoscanAngles)
    if told or settings.exposure_s or ride.counters.camera is not None:
        return ""
    return f" Nothing tells the exposure yet: its frames must have the attribute {EXPOSURE}, else set ride.exposure_s."


def _with_exposure(plan: RidePlan, ride: Ride, first: ArrayFrame) -> RidePlan:
    """The plan with an exposure of its views."""
    camera, told = ride.counters.camera, first.attributes.get(EXPOSURE)
    known = (
        ride.config.ride.exposure_s,
        plan.exposures.get(FrameKind.PROJECTION),
        told if isinstance(told, int | float) else None,
        None if camera is None else camera.number("AcquireTime_RBV"),
    )
    seconds = next((each for each in known if each), None)
    if seconds is None:
        raise ConfigError(
            f"Nothing tells the exposure: the frames have no attribute {EXPOSURE}, and ride.camera names no camera. "
            "Set ride.exposure_s. Nothing was recorded."
        )
    period = plan.period or (None if camera is None else camera.number("AcquirePeriod_RBV"))
    exposures = {**plan.exposures, FrameKind.PROJECTION: float(seconds)}
    return replace(plan, exposures=exposures, period=period if period and math.isfinite(period) else None)


def _with_given(plan: RidePlan, given: Images, shape: tuple[int, int]) -> RidePlan:
    for kind, images in given.items():
        if images.shape[1:] != shape:
            raise ConfigError(
                f"--{kind.name.lower()}s has frames of {images.shape[1]} x {images.shape[2]} pixels, the camera of "
                f"{shape[0]} x {shape[1]}: give those of this region and binning. Nothing was recorded."
            )
    blocks = tuple(PlannedBlock(kind, len(images)) for kind, images in given.items())
    return replace(plan, blocks=(*blocks, *plan.blocks))


def load_given(darks: str | None, flats: str | None) -> Images:
    """Darks and flats of files, rounded to counts. Raises ConfigError for what cannot be counts of a camera."""
    given = {}
    for kind, name in ((FrameKind.DARK, darks), (FrameKind.FLAT, flats)):
        if name is None:
            continue
        try:
            images = load_images(name, kind)
        except BeamlineError as error:
            raise ConfigError(f"--{kind.name.lower()}s: {error}") from error
        counts = np.rint(images)  # means of others' frames are real numbers
        if not (images.size and counts.min() >= 0 and counts.max() <= np.iinfo(np.uint16).max):
            raise ConfigError(
                f"--{kind.name.lower()}s {name} has no counts: they are numbers from 0 to 65535. Nothing was recorded."
            )
        given[kind] = counts.astype(np.uint16)
    return given


def opened(config: RideConfig, held: ExitStack) -> tuple[FrameStream, Guide, Counters]:
    """The stream, the guide and the counters of a ride, closed with `held`.

    Raises:
        DeviceTimeout: a server does not answer.
        ConfigError: a name is wrong, or the image is unfit, as by its port.
    """
    settings = config.ride
    stream = held.enter_context(FrameStream(settings.image, settings.queues, settings.period_s))
    counters = Counters(settings.image, settings.camera)
    held.callback(counters.close)
    refuse_mistakes(config, counters, stream.first)
    guide = guide_of(settings)
    held.callback(guide.close)
    return stream, guide, counters
