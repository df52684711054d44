"""Waits for the scan of another program and records it. If its frame numbers restart, another file begins."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import numpy as np

from beamline.core.errors import BeamlineError, ConfigError
from beamline.core.events import Sink
from beamline.core.run_result import RunResult
from beamline.core.stop import ScanAborted
from beamline.scan.live_process import Standby
from beamline.scan.run import record_scan
from beamline.storage.readers.reference_files import load_images
from drivers.base.frame import FrameKind
from splatline_areadetector.arrays import ArrayFrame
from splatline_areadetector.config import RideConfig, TomoscanAngles
from splatline_areadetector.counters import Counters, Silence, refuse_mistakes
from splatline_areadetector.frame_places import BY_ORDER, UNKNOWN_KIND, Seen
from splatline_areadetector.guides import EXPOSURE, Guide, guide_of, seconds_of
from splatline_areadetector.plan import PlannedBlock, RidePlan, ready_of
from splatline_areadetector.ridden import (
    SECOND,
    SLICE,
    EpochEndedError,
    Images,
    RiddenFrames,
    Ride,
    outside_sentence,
    seen_of,
)
from splatline_areadetector.sorter import n_before_views, not_set
from splatline_areadetector.stream import FrameStream, Refused


class NoScanError(ScanAborted):
    """Stopped while waiting for a scan."""


def ride_scan(ride: Ride, sinks: Sequence[Sink], *, live: Standby | None) -> RunResult:
    """Record the next scan of the stream in a run. If the frame numbers restart, each part becomes a separate run.

    Args:
        live: process that loads its code while waiting for a scan, and then makes the live volume; None: no live
            volume.

    Raises:
        ConfigError: the frames cannot be stored, or their angles are not known; nothing was recorded.
        LedgerError: frames are missing in one of the files; the last such error, after all of them are closed.
        BeamlineError, DeviceError: as for `record_scan`.
    """
    config, lost = ride.config.as_scan, None
    first_id = ride.config.ride.first_id
    while True:
        if live is not None:
            live.prepare()
        first, before = wait_for_scan(ride, first_id, began_within_scan=lost is not None)
        refuse_mistakes(ride.config, ride.counters, first)
        own = _with_exposure(ride.guide.plan(), ride, first)
        plan = _with_given(own, ride.given, first.window.shape)
        ready = ready_of(ride.config, plan, first, ride.runs)
        source_of = partial(RiddenFrames, ride, own, first_id, before, lost is not None)
        try:
            result = record_scan(config, ready, source_of, ride.runs, sinks, ride.stop, live=live)
        except EpochEndedError as error:
            lost, first_id = error, None  # the numbers have restarted
            continue
        if lost is not None:
            raise lost
        return result


def wait_for_scan(ride: Ride, first_id: int | None, *, began_within_scan: bool) -> tuple[ArrayFrame, Seen | None]:
    """Wait for the first frame of a scan. Returns this frame, which stays in the stream, and the frame before it.
    Earlier frames are dropped.

    Args:
        began_within_scan: a file of this scan has been closed already.

    Raises:
        NoScanError: a stop was requested.
        ConfigError: the frames cannot be stored.
        InstrumentError: the server does not answer.
    """
    stream, guide = ride.stream, ride.guide
    silence = Silence(stream, ride.counters, ride.config.ride.silence_s, ride.say, lambda: "Nothing was recorded.")
    reported, known = False, stream.first
    before = None if known is None else Seen(known.unique_id, BY_ORDER, known.time)
    if began_within_scan and known is not None:
        before = seen_of(known, guide)
    now = f" Now: {guide.status}." if guide.status else ""
    ride.say(f"Waiting for the first frame of a scan from {stream.name}{_shown(ride)}{now}")
    while not ride.stop.stopping:
        item = stream.next(SLICE)
        if isinstance(item, Refused):
            raise ConfigError(f"The frames of {stream.name} cannot be stored: {item.why}. Nothing was recorded.")
        if not isinstance(item, ArrayFrame):
            silence.look()
            continue
        silence.frame_came()
        if item.is_current and known is not None and item.time <= known.time:  # it was there before
            continue
        seen = seen_of(item, guide)
        if _begins(seen, ride, first_id):
            if not _is_alone(item, ride):
                stream.put_back(item)
                return item, before
            continue
        before = before if seen.phase == UNKNOWN_KIND else seen
        if not reported:
            reported = True
            ride.say(outside_sentence(guide))
    raise NoScanError(f"Interrupted before the first frame: {ride.stop.reason}. Nothing was recorded.")


def _begins(seen: Seen, ride: Ride, first_id: int | None) -> bool:
    """Whether this frame belongs to the scan."""
    if seen.phase == BY_ORDER:
        return first_id is None or seen.number >= first_id - n_before_views(ride.guide.plan().blocks)
    kind = seen.phase.kind
    return kind is not None and (kind is not FrameKind.PROJECTION or seen.number >= (first_id or seen.number))


def _is_alone(first: ArrayFrame, ride: Ride) -> bool:
    """Whether the next frames have another size. Raises ConfigError if they have the same number but other pixels."""
    ahead = [each for each in ride.stream.ahead(2, SECOND) if isinstance(each, ArrayFrame)]
    if ahead and ahead[0].unique_id == first.unique_id and not np.array_equal(ahead[0].payload, first.payload):
        raise ConfigError(f"{not_set(first.unique_id)}. Nothing was recorded.")
    if len(ahead) < 2 or first.kind == ahead[0].kind or ahead[0].kind != ahead[1].kind:
        return False
    ride.say(f"Frame {first.unique_id} is not stored, because it has another size than the frames after it.")
    return True


def _shown(ride: Ride) -> str:
    """The end of the sentence about a stream, from the frame that its server has. It warns if only the first frame of
    the scan can tell the exposure time."""
    if (first := ride.stream.first) is None:
        return "."
    untold = not isinstance(ride.config.ride.angles, TomoscanAngles) and _exposure(ride, None, first) is None
    return f" ({first.window.shape[0]} x {first.window.shape[1]} {first.dtype})." + (
        " The exposure time is not known yet: set ride.exposure_s, unless the frames will have the attribute "
        f"{EXPOSURE}."
        if untold
        else ""
    )


def _exposure(ride: Ride, planned: float | None, first: ArrayFrame) -> float | None:
    """Exposure time of a projection in s, from the first of these that has it: configuration, plan, frame, camera."""
    camera, by_frame = ride.counters.camera, seconds_of(first.attributes.get(EXPOSURE))
    by_camera = None if camera is None else seconds_of(camera.number("AcquireTime_RBV"))
    return ride.config.ride.exposure_s or seconds_of(planned) or by_frame or by_camera


def _with_exposure(plan: RidePlan, ride: Ride, first: ArrayFrame) -> RidePlan:
    """The plan, with the exposure time of the projections added."""
    seconds = _exposure(ride, plan.exposures.get(FrameKind.PROJECTION), first)
    if seconds is None:
        raise ConfigError(
            f"Set ride.exposure_s: the exposure time is not known, because the frames have no attribute {EXPOSURE}, "
            "and ride.camera names no camera. Nothing was recorded."
        )
    camera = ride.counters.camera
    period = plan.period or (None if camera is None else seconds_of(camera.number("AcquirePeriod_RBV")))
    exposures = {kind: each for kind, each in plan.exposures.items() if seconds_of(each)}
    return replace(plan, exposures={**exposures, FrameKind.PROJECTION: seconds}, period=period)


def _with_given(plan: RidePlan, given: Images, shape: tuple[int, int]) -> RidePlan:
    for kind, images in given.items():
        if images.shape[1:] != shape:
            raise ConfigError(
                f"The frames of --{kind.name.lower()}s have {images.shape[1]} x {images.shape[2]} pixels, but the "
                f"camera's frames have {shape[0]} x {shape[1]}: give frames with the camera's region and binning. "
                "Nothing was recorded."
            )
    blocks = tuple(PlannedBlock(kind, len(images)) for kind, images in given.items())
    return replace(plan, blocks=(*blocks, *plan.blocks))


def load_given(darks: str | None, flats: str | None) -> Images:
    """Darks and flats from files, rounded to counts. Raises ConfigError if they cannot be counts of a camera."""
    images_of_kinds = {}
    for kind, name in ((FrameKind.DARK, darks), (FrameKind.FLAT, flats)):
        if name is None:
            continue
        try:
            images = load_images(name, kind)
        except BeamlineError as error:
            raise ConfigError(f"--{kind.name.lower()}s: {error}") from error
        counts = np.rint(images)  # averaged frames of other programs are floating-point numbers
        if not (images.size and counts.min() >= 0 and counts.max() <= np.iinfo(np.uint16).max):
            raise ConfigError(
                f"--{kind.name.lower()}s {name} must hold counts (numbers from 0 to 65535). Nothing was recorded."
            )
        images_of_kinds[kind] = counts.astype(np.uint16)
    return images_of_kinds


def opened(config: RideConfig, held: ExitStack) -> tuple[FrameStream, Guide, Counters]:
    """The stream, the guide and the counters that `beamline ride` uses; `held` closes them.

    Raises:
        DeviceTimeout: a server does not answer.
        ConfigError: a name is wrong, or the image cannot be recorded, for example because of its port.
    """
    settings = config.ride
    stream = held.enter_context(FrameStream(settings.image, settings.queues, settings.period_s))
    counters = Counters(settings.image, settings.camera)
    held.callback(counters.close)
    refuse_mistakes(config, counters, stream.first)
    guide = guide_of(settings)
    held.callback(guide.close)
    return stream, guide, counters
