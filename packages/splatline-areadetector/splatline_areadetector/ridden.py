"""RiddenFrames: the frames of one epoch of somebody else's scan, in the order of our file, each with kind and angle."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError, InstrumentError, ScanStopped
from beamline.core.events import BlockDone, BlockStarted, StateEntered, Warned
from beamline.core.stop import ScanAborted
from beamline.core.text import count, spans
from beamline.scan.control import State
from beamline.scan.ledger import LedgerError
from beamline.scan.measurement import Measurement
from drivers.base.frame import Frame, FrameKind
from splatline_areadetector.arrays import ArrayFrame
from splatline_areadetector.guides import EXPOSURE, Guide
from splatline_areadetector.losses import Counters, Gap, losses_told
from splatline_areadetector.plan import RidePlan
from splatline_areadetector.sorter import NewEpoch, Outside, Place, Sorter
from splatline_areadetector.stream import Died, Disconnected, FrameStream, Overflow, Refused

SLICE = 0.25  # s: the longest wait for a frame between two looks at the stop request
SETTLES = 0.2  # s in which the camera's counter comes here, after the frame that it counts
SECOND = 1.0  # s to wait for a second projection before the first is given its angle
_STATES = {FrameKind.DARK: State.DARKS, FrameKind.FLAT: State.FLATS, FrameKind.PROJECTION: State.ACQUIRING}

Images = Mapping[FrameKind, NDArray[Any]]
"""Darks and flats [frame, row, col] from files, where the scan takes none."""


@dataclass(frozen=True, eq=False)
class Journey:
    """What a ride goes by: the stream, what tells of the scan, and what was known of it at its first frame.

    Attributes:
        counters: of plugin and camera.
        given: darks and flats from files, which come first.
        first_id: see `RideSection`.
        silence: s without a frame, after which it is said why.
    """

    stream: FrameStream
    guide: Guide
    plan: RidePlan
    counters: Counters
    given: Images
    first_id: int | None
    silence: float


class RiddenFrames:
    """A `FrameSource`: takes frames from the stream until the scan is complete, its numbers begin anew, or a stop.

    Attributes:
        epoch: why the file ends before the scan, and another begins; "" where it does not.
    """

    recovered, unsafe = 0, False

    def __init__(self, journey: Journey, measurement: Measurement, now: Callable[[], float] = time.time) -> None:
        self._by, self._measurement, self._now = journey, measurement, now
        self._stream, self._guide, self._plan = journey.stream, journey.guide, journey.plan
        self._sink, self._stop = measurement.sink, measurement.stop
        self._sorter = Sorter(journey.plan.blocks, journey.first_id)
        self._gaps: list[Gap] = []
        self._overflowed: set[int] = set()
        self._kind: tuple[Any, ...] | None = None
        self._last: ArrayFrame | None = None
        self._block, self._block_kind, self._in_block = -1, "", 0
        self._gone = self._told_of_outside = False
        self._told_pause = ""
        self._row = self._views = 0
        self._came_at = time.monotonic()
        self.epoch = ""

    @property
    def missing(self) -> list[int]:
        first = sum(map(len, self._by.given.values()))
        firsts = [first + each for each in self._plan.first_triggers]
        return [firsts[i] + trigger for i in range(len(firsts)) for trigger in self._sorter.missing(i)]

    def frames(self) -> Generator[Frame, None, None]:
        """See `FrameSource`. LedgerError names the frames that are missing, and whose loss they are."""
        yield from self._from_files()
        yield from self._from_stream()
        self._end_block()
        self._raise_outcome()

    def _from_files(self) -> Iterator[Frame]:
        for kind, images in self._by.given.items():
            self._measurement.states.enter(_STATES[kind])
            for i, counts in enumerate(images):
                seconds = self._plan.exposure(kind)
                yield Frame(np.array(counts, np.uint16), kind, self._row, i, -1, math.nan, self._now(), seconds)
                self._row += 1

    def _from_stream(self) -> Iterator[Frame]:
        while not (self._sorter.complete or self._stop.aborting):
            self._refuse_pause()
            item = self._stream.next(0.0 if self._stop.stopping else SLICE)
            match item:
                case None:
                    if self._stop.stopping or self._is_over():
                        return
                    self._look_at_silence()
                case Disconnected():
                    self._gone = True
                    self._sink(Warned(f"{self._stream.name}: its server has gone. The ride waits for it."))
                case Died(code):
                    self._sink(Warned(f"The process that receives frames has ended ({code}): another one is started."))
                case Overflow(unique_id):
                    self._overflowed.add(unique_id)
                    if (lost := self._sorter.pass_over(unique_id)) and self._last is not None:
                        self._gaps.append(Gap(lost, self._last.time, self._last.time))
                case Refused(unique_id, why):
                    raise DataError(
                        f"Frame {unique_id} of {self._stream.name} cannot be stored: {why}. What came before is in "
                        "the file."
                    )
                case ArrayFrame():
                    if self._is_old(item):
                        continue
                    if frame := self._placed(item):
                        yield frame
                        self._row += 1
                    if self.epoch or (self._in_block == 0 and self._guide.ended(item.time)):
                        return

    def _is_old(self, frame: ArrayFrame) -> bool:
        """Whether it is what the server still had when it was connected."""
        return frame.is_current and (self._last is None or frame.time <= self._last.time)

    def _is_over(self) -> bool:
        return self._guide.ended(math.inf) and time.monotonic() - self._came_at > SECOND

    def _placed(self, frame: ArrayFrame) -> Frame | None:
        """The frame of the file; None: it belongs to no scan, cannot be read, or to the next file."""
        self._came_at = time.monotonic()
        place = self._place(frame)
        if isinstance(place, NewEpoch):
            self.epoch = place.why
            self._sink(Warned(f"{place.why}: the file ends, another begins."))
            self._stream.put_back(frame)
            return None
        before, self._last, self._gone = self._last, frame, False
        if isinstance(place, Outside):
            self._end_block()
            self._tell_of_outside(place)
            return None
        if place.block != self._block:
            place = self._begin_block(place, frame)
        if place.skipped and before is not None:
            still = self._stream.stood_still(before.time, frame.time)
            ids = range(frame.unique_id - len(place.skipped), frame.unique_id)
            self._gaps.append(Gap(ids, before.time, frame.time, still))
        try:
            counts = frame.counts()
        except ValueError as error:
            self._sorter.lose(place)
            self._sink(Warned(f"Frame {frame.unique_id}: {error}. It counts as missing."))
            return None
        return self._frame(frame, counts, place)

    def _place(self, frame: ArrayFrame) -> Place | Outside | NewEpoch:
        if self._kind is None:
            self._kind = frame.kind
        if frame.kind != self._kind:
            (before, dtype), (after, other) = self._kind, frame.kind
            return NewEpoch(
                f"frames are {after.shape[0]} x {after.shape[1]} {other} from number {frame.unique_id} on, after "
                f"{before.shape[0]} x {before.shape[1]} {dtype}"
                + ("" if (before.shape, dtype) != (after.shape, other) else ", of another part of the sensor")
            )
        return self._sorter.take(frame.unique_id, self._guide.phase(frame), reconnected=self._gone)

    def _frame(self, frame: ArrayFrame, counts: NDArray[np.uint16], place: Place) -> Frame:
        kind, angle = place.kind, math.nan
        if kind is FrameKind.PROJECTION:
            angle = self._guide.angle(frame, place.trigger)
            self._views += 1
            if math.isnan(angle):
                kind = FrameKind.INVALID
                self._sorter.lose(place)
                self._sink(Warned(f"Nothing tells the angle of frame {frame.unique_id}: it is kept as an invalid row."))
        exposure = frame.attributes.get(EXPOSURE)
        seconds = float(exposure) if isinstance(exposure, int | float) else self._plan.exposure(place.kind)
        self._in_block += 1
        return Frame(counts, kind, self._row, place.trigger, frame.unique_id, angle, frame.time, seconds)

    def _begin_block(self, place: Place, frame: ArrayFrame) -> Place:
        self._end_block()
        self._block, kind = place.block, place.kind
        if kind is FrameKind.PROJECTION and self._by.first_id is None and (lost := self._lost_before(frame)):
            self._sorter.shift_first(lost)
            place = Place(place.block, kind, place.trigger + lost, range(lost))
            self._sink(Warned(f"The camera had counted {count(lost, 'projection')} before the first that came."))
        n = self._plan.blocks[place.block].n if place.block < len(self._plan.blocks) else 0
        self._block_kind = kind.name.lower()
        exposure, period = self._plan.exposure(kind), self._plan.period or 0.0
        self._sink(BlockStarted(self._block_kind, "ridden", n, self._row, exposure, period))
        self._measurement.states.enter(_STATES[kind])
        return place

    def _end_block(self) -> None:
        if not self._in_block:
            return
        planned = self._block < len(self._plan.blocks)
        missing = self._sorter.missing(self._block) if planned else []
        n = self._plan.blocks[self._block].n if planned else self._in_block
        first, lost = self._row - self._in_block, len(missing)
        self._sink(BlockDone(self._block_kind, "ridden", n, first, self._in_block, missing, lost, 0, 0))
        self._in_block = 0

    def _lost_before(self, frame: ArrayFrame) -> int:
        """Projections that the camera had counted before this one, the first that came. It counts a frame about when it
        sends it, so it is asked between the first and the second one."""
        camera = self._by.counters.camera
        if camera is None:
            return 0
        second = self._stream.next(SECOND)
        if second is not None:
            self._stream.put_back(second)
        time.sleep(SETTLES)
        history, at = camera.histories["NumImagesCounter_RBV"], math.inf
        if isinstance(second, ArrayFrame) and second.unique_id == frame.unique_id + 1:
            at = frame.time + 0.7 * (second.time - frame.time)
        elif second is not None:
            return 0
        values = history.until(at)
        lost = int(float(values[-1])) - 1 if values else 0
        return lost if 0 < lost < self._plan.angles.size else 0

    def _tell_of_outside(self, place: Outside) -> None:
        if place.repeated or self._told_of_outside:
            return
        self._told_of_outside = True
        status = f" ({self._guide.status})" if self._guide.status else ""
        self._sink(StateEntered(self._measurement.states.state, f"Frames of no scan come{status}: they are not stored"))

    def _refuse_pause(self) -> None:
        reason = self._measurement.pause.reason
        if reason and reason != self._told_pause:
            self._sink(Warned(f"The scan is another program's, and goes on: it should pause, as {reason}."))
        self._told_pause = reason
        self._measurement.pause.resume()

    def _look_at_silence(self) -> None:
        if time.monotonic() - self._came_at < self._by.silence:
            return
        self._came_at = time.monotonic()  # said again after as long
        if not self._stream.answers():
            raise InstrumentError(
                f"{self._stream.name}: no frame for {self._by.silence:g} s, and its server does not answer. What came "
                f"before is in the file.{self._told()}"
            )
        why = silence_told(self._by.counters)
        self._sink(Warned(f"No frame for {self._by.silence:g} s, the server answers: {why}."))

    def _told(self) -> str:
        """Sentences on what is missing and whose loss it was, each after a space."""
        words = []
        for i, block in enumerate(self._plan.blocks):
            if missing := self._sorter.missing(i):
                noun, angles = block.kind.name.lower(), self._plan.angles
                at = ""
                if block.kind is FrameKind.PROJECTION and not np.isnan(angles).any():
                    first, last = (math.degrees(angles[missing[end]]) for end in (0, -1))
                    at = f" (from {first:.4g}° to {last:.4g}°)"
                words.append(f"{len(missing)} of {block.n} {noun}s are missing: {spans(missing)}{at}.")
                if at and missing[0] == block.n - len(missing) and not (self._stop.stopping or self.epoch):
                    words.append(self._first_or_last(missing))
        words += losses_told(self._gaps, self._overflowed, self._by.counters)
        if self._sorter.repeats:
            words.append(f"{count(self._sorter.repeats, 'frame')} came twice and were stored once.")
        return "".join(f" {sentence}" for sentence in words if sentence)

    def _first_or_last(self, missing: Sequence[int]) -> str:
        """A sentence on projections that are missing at the end, of a scan that ended: "" where their number is known.

        No view shows it: the same turn of all angles gives the same views of a turned sample.
        """
        if self._by.counters.camera is not None or self._by.first_id is not None:
            return ""
        angles, n = self._plan.angles, len(missing)
        return (
            f"As nothing tells the number of the first one, it may be the first {n} that are missing: then all angles "
            f"are {math.degrees(angles[n] - angles[0]):.4g}° more, by which the volume is turned, and nothing else. "
            "ride.camera or ride.first_id tells it."
        )

    def _raise_outcome(self) -> None:
        told, planned = self._told(), self._plan.angles.size
        if self._stop.aborting:
            raise ScanAborted(f"Aborted: {self._stop.reason}.{told}")
        if self._stop.stopping and not self._sorter.complete:
            raise ScanStopped(
                f"Stopped after {self._views} of {planned} projections: {self._stop.reason}. The file is complete as "
                f"far as it goes.{told}"
            )
        if self.missing:
            epoch = f" The file ends there, as {self.epoch}." if self.epoch else ""
            raise LedgerError(
                f"{told.strip()}{epoch} Every other frame is in the file with the angle of its number.", self.missing
            )


def silence_told(counters: Counters) -> str:
    """Why no frames may come, as far as the IOC tells, as a sentence's end."""
    plugin, camera = counters.plugin, counters.camera
    if plugin.text("EnableCallbacks_RBV") == "Disable":
        return f"{plugin.prefix}EnableCallbacks is Disable; set it to Enable"
    if camera is None:
        return "the camera waits for triggers, or does not acquire (ride.camera would tell)"
    if camera.text("ArrayCallbacks_RBV") == "Disable":
        return f"{camera.prefix}ArrayCallbacks is Disable; set it to Enable"
    state = camera.text("DetectorState_RBV")
    if camera.text("Acquire_RBV") in ("Done", "0.0"):
        return f"the camera does not acquire ({camera.prefix}Acquire is Done{f', {state}' if state else ''})"
    return "the camera waits for triggers"
