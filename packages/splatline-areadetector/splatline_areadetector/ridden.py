"""RiddenFrames: the frames of another program's scan, in the order of the file that is written, each with kind and
angle.

An epoch is a part of the scan in which the frame numbers do not restart. Each epoch is stored in one file.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError, ScanStopped
from beamline.core.events import BlockDone, BlockStarted, StateEntered, Warned
from beamline.core.stop import ScanAborted, StopRequest
from beamline.core.text import count
from beamline.scan.control import State
from beamline.scan.ledger import EXTRA, LedgerError
from beamline.scan.measurement import Measurement
from drivers.base.frame import Frame, FrameKind
from splatline_areadetector.arrays import ArrayFrame
from splatline_areadetector.config import RideConfig
from splatline_areadetector.counters import Counters, Gap, Silence
from splatline_areadetector.frame_places import Decision, FramePosition, NewEpoch, Outside, Seen, Unknown
from splatline_areadetector.guides import EXPOSURE, Guide, seconds_of
from splatline_areadetector.losses import Losses, first_or_last_sentence, missing_sentences
from splatline_areadetector.plan import RidePlan
from splatline_areadetector.sorter import Sorter
from splatline_areadetector.stream import Died, Disconnected, FrameStream, Overflow, Refused

SLICE = 0.25  # s: longest wait for a frame before the stop request is checked again
SECOND = 1.0  # s without a frame, after which waiting frames no longer wait for earlier numbers
_STATES = {FrameKind.DARK: State.DARKS, FrameKind.FLAT: State.FLATS, FrameKind.PROJECTION: State.ACQUIRING}

Images = Mapping[FrameKind, NDArray[Any]]
"""Darks and flats [frame, row, col] from files, for a scan that takes none."""


@dataclass(frozen=True, eq=False)
class Ride:
    """Everything that `beamline ride` uses, connected.

    Attributes:
        counters: those of the plugin and the camera.
        given: darks and flats from files, for a scan that takes none; they are stored first.
        runs: the folder for the folders of runs.
        say: prints messages while there is no run.
    """

    config: RideConfig
    stream: FrameStream
    guide: Guide
    counters: Counters
    given: Images
    runs: Path
    stop: StopRequest
    say: Callable[[str], None]


class EpochEndedError(LedgerError):
    """The file was closed before the end of the scan, because frame numbers restarted or the frame size changed."""


def outside_sentence(guide: Guide) -> str:
    """The message about frames that arrive outside of a scan."""
    status = f" ({guide.status})" if guide.status else ""
    return f"Frames that arrive outside of a scan{status} are not stored."


class RiddenFrames:
    """A `FrameSource`: takes frames from the stream until the scan is complete, numbers restart, or a stop comes."""

    recovered, unsafe = 0, False

    def __init__(
        self, ride: Ride, plan: RidePlan, first_id: int | None, before: Seen | None, began_within_scan: bool,
        measurement: Measurement,
    ) -> None:  # fmt: skip
        self._ride, self._plan, self._measurement = ride, plan, measurement
        self._stream, self._guide = ride.stream, ride.guide
        self._sink, self._stop = measurement.sink, measurement.stop
        self._sorter = Sorter(plan.blocks, first_id, ride.counters, before, began_within_scan=began_within_scan)
        self._losses = Losses()
        self._last: ArrayFrame | None = None  # the last frame that has a place in the plan
        self._arrived: ArrayFrame | None = None  # the last frame
        self._block, self._block_kind, self._in_block = -1, "", 0
        self._gone = self._reported_outside = False
        self._reported_pause = self._epoch = ""
        self._row = self._views = 0
        self._silence = Silence(
            ride.stream, ride.counters, ride.config.ride.silence_s, self._warn,
            lambda: f"Earlier frames are in the file.{self._loss_sentences(ended=False)}",
        )  # fmt: skip

    @property
    def missing(self) -> list[int]:
        given = sum(map(len, self._ride.given.values()))
        firsts = enumerate(self._plan.first_triggers)
        return [given + first + trigger for i, first in firsts for trigger in self._sorter.missing(i)]

    def frames(self) -> Generator[Frame, None, None]:
        """See `FrameSource`. LedgerError lists the missing frames and the causes of the loss."""
        yield from self._from_files()
        yield from self._from_stream()
        if not self._sorter.complete:  # otherwise the held frames belong to the next scan
            yield from self._stored(self._sorter.decided(0))
        for seen in reversed(self._sorter.held):
            self._stream.put_back(seen.frame)
        self._stream.first = self._last or self._stream.first
        self._end_block(is_last=True)
        self._raise_outcome()

    def _from_files(self) -> Iterator[Frame]:
        for kind, images in self._ride.given.items():
            self._measurement.states.enter(_STATES[kind])
            for i, counts in enumerate(images):
                yield Frame(counts, kind, self._row, i, -1, math.nan, time.time(), self._plan.exposure(kind))
                self._row += 1

    def _from_stream(self) -> Iterator[Frame]:
        stored_until = 0.0
        while not (self._sorter.complete or self._stop.aborting):
            self._refuse_pause()
            item = self._stream.next(SLICE)
            if self._stop.stopping:  # frames on their way are still stored
                stored_until = stored_until or time.time() + SLICE
                if item is None or (isinstance(item, ArrayFrame) and item.received > stored_until):
                    return
            match item:
                case None:
                    if self._silence.lasted > SECOND:
                        yield from self._stored(self._sorter.decided(1))
                        if self._guide.ended(math.inf):
                            return
                    self._silence.look()
                case Disconnected():
                    self._gone = True
                    self._warn(
                        f"The connection to the server of {self._stream.name} was lost. Waiting until the server is "
                        "back."
                    )
                case Died(code):
                    self._warn(
                        f"The process that receives frames has ended (exit code {code}); a new process is being "
                        "started."
                    )
                case Overflow(unique_id):
                    self._losses.overflowed.add(unique_id)
                    yield from self._stored(self._sorter.decided(1))
                    if (lost := self._sorter.pass_over(unique_id)) and self._last is not None:
                        self._losses.gaps.append(Gap(lost, self._last.time, self._last.time))
                case Refused(unique_id, why):
                    raise DataError(
                        f"Frame {unique_id} of {self._stream.name} cannot be stored: {why}. Earlier frames are in "
                        "the file."
                    )
                case ArrayFrame():
                    if item.is_current and self._arrived is not None and item.time <= self._arrived.time:
                        continue  # an old frame that the server still had
                    self._silence.frame_came()
                    self._arrived, seen = item, seen_of(item, self._guide, gone=self._gone)
                    self._gone = False
                    yield from self._stored(self._sorter.take(seen))
                    if self._epoch or (self._in_block == 0 and self._guide.ended(item.time)):
                        return

    def _stored(self, decided: Iterable[tuple[Seen, Decision]]) -> Iterator[Frame]:
        """The frames that go into the file, until it is closed."""
        for seen, decision in decided:
            if (frame := self._placed(seen, decision)) is not None:
                yield frame
                self._row += 1
            if self._epoch or self._sorter.complete:
                return

    def _warn(self, sentence: str) -> None:
        self._sink(Warned(sentence))

    def _placed(self, seen: Seen, place: Decision) -> Frame | None:
        """The frame for the file. None: it does not belong to the scan, cannot be decoded, or belongs to the next
        file."""
        frame: ArrayFrame = seen.frame
        if isinstance(place, NewEpoch):
            self._epoch = place.why or self._other_size(frame)
            self._warn(f"Closing this file and beginning another file, because {self._epoch}.")
            for each in (*reversed(self._sorter.held), seen):
                self._stream.put_back(each.frame)
            self._sorter.held.clear()
            return None
        if isinstance(place, Unknown):
            return self._unknown(frame, place)
        before, self._last = self._last, frame
        if isinstance(place, Outside):
            if place.lost and before is not None:
                self._add_gap(place.lost, before, frame)
            if not place.repeated:
                self._end_block()
            if not (place.repeated or self._reported_outside):
                self._reported_outside = True
                self._sink(StateEntered(self._measurement.states.state, outside_sentence(self._guide)))
            return None
        if place.note:
            self._warn(place.note)
        if place.block != self._block:
            self._begin_block(place)
        if place.skipped and before is not None:
            self._add_gap(range(seen.number - len(place.skipped), seen.number), before, frame)
        if (counts := self._counts(frame)) is None:
            self._sorter.lose(place)
            return None
        return self._frame(frame, counts, place)

    def _counts(self, frame: ArrayFrame) -> NDArray[np.uint16] | None:
        try:
            return frame.counts()
        except ValueError as error:
            self._cannot_use(frame, str(error))
        return None

    def _cannot_use(self, frame: ArrayFrame, why: str) -> None:
        if self._losses.is_first_unused(why, frame.unique_id):
            self._warn(
                f"Frame {frame.unique_id} counts as missing: {why}. Further frames of this kind are listed at the end."
            )

    def _unknown(self, frame: ArrayFrame, place: Unknown) -> Frame | None:
        """A frame that cannot be assigned, stored as an invalid row if it has the size of the others. The first frame
        of each cause gives a message, and all are listed at the end."""
        fate = "stored as an invalid row" if place.fits else "not stored"
        if self._losses.is_first_unplaced(f"{place.why} ({fate})", frame.unique_id):
            self._warn(f"Frame {frame.unique_id} is {fate}, because {place.why}.")
        if not place.fits or (counts := self._counts(frame)) is None:
            return None
        self._in_block += bool(self._in_block)
        return Frame(
            counts, FrameKind.INVALID, self._row, EXTRA, frame.unique_id, math.nan, frame.time,
            self._plan.exposure(FrameKind.PROJECTION),
        )  # fmt: skip

    def _add_gap(self, ids: range, before: ArrayFrame, after: ArrayFrame) -> None:
        still = self._stream.stalled_seconds(before.time, after.time)
        self._losses.gaps.append(Gap(ids, before.time, after.time, still))

    def _other_size(self, frame: ArrayFrame) -> str:
        """Why the file is closed: a frame of another size or type."""
        assert self._last is not None
        (before, dtype), (after, dtype_after) = self._last.kind, frame.kind
        return (
            f"frames from number {frame.unique_id} on have {after.shape[0]} x {after.shape[1]} pixels of "
            f"{dtype_after}, and earlier frames have {before.shape[0]} x {before.shape[1]} pixels of {dtype}"
            + ("" if (before.shape, dtype) != (after.shape, dtype_after) else ", and show another part of the sensor")
        )

    def _frame(self, frame: ArrayFrame, counts: NDArray[np.uint16], place: FramePosition) -> Frame:
        kind, angle = place.kind, math.nan
        if kind is FrameKind.PROJECTION:
            angle = self._guide.angle(frame, place.trigger)
            if math.isnan(angle):
                kind = FrameKind.INVALID
                self._sorter.lose(place)
                self._cannot_use(frame, f"{self._guide.unknown_angle}, so the frame is stored as an invalid row")
            else:
                self._views += 1
        seconds = seconds_of(frame.attributes.get(EXPOSURE)) or self._plan.exposure(place.kind)
        self._in_block += 1
        return Frame(counts, kind, self._row, place.trigger, frame.unique_id, angle, frame.time, seconds)

    def _begin_block(self, place: FramePosition) -> None:
        self._end_block()
        self._block, kind = place.block, place.kind
        n = self._plan.blocks[place.block].n if place.block < len(self._plan.blocks) else 0
        self._block_kind = kind.name.lower()
        exposure, period = self._plan.exposure(kind), self._plan.period or 0.0
        self._sink(BlockStarted(self._block_kind, "ridden", n, self._row, exposure, period))
        self._measurement.states.enter(_STATES[kind])

    def _end_block(self, *, is_last: bool = False) -> None:
        if not self._in_block:
            return
        planned = self._block < len(self._plan.blocks)
        is_over = planned and (is_last or self._sorter.is_over(self._block))  # else it continues after others
        missing = self._sorter.missing(self._block) if is_over else []
        n = self._plan.blocks[self._block].n if planned else self._in_block
        first, lost = self._row - self._in_block, len(missing)
        self._sink(BlockDone(self._block_kind, "ridden", n, first, self._in_block, missing, lost, 0, 0))
        self._in_block, self._block = 0, -1

    def _refuse_pause(self) -> None:
        reason = self._measurement.pause.reason
        if reason and reason != self._reported_pause:
            self._warn(
                f"There is a reason to pause the scan: {reason}. But the scan continues, because another program runs "
                "it."
            )
        self._reported_pause = reason
        self._measurement.pause.resume()

    def _loss_sentences(self, *, ended: bool) -> str:
        """Sentences on the missing frames and the causes of the loss, each after a space.

        Args:
            ended: whether the scan ended by itself, without a stop and without a new epoch.
        """
        words = missing_sentences(self._plan, self._sorter)
        if self._views:
            words.append(first_or_last_sentence(self._plan, self._sorter, ended=ended))
        words += self._losses.sentences(lambda: self._guide.status, self._ride.counters, self._sorter.repeats)
        return "".join(f" {sentence}" for sentence in words if sentence)

    def _raise_outcome(self) -> None:
        since = math.inf if self._arrived is None else time.time() - self._arrived.received
        ended = not (
            self._epoch or (self._stop.stopping and since < SECOND)
        )  # a stop after the last frame changed nothing
        sentences, planned = self._loss_sentences(ended=ended), self._plan.angles.size
        if self._stop.aborting:
            raise ScanAborted(f"Aborted: {self._stop.reason}.{sentences}")
        if self._stop.stopping and not self._sorter.complete:
            raise ScanStopped(
                f"Stopped after {self._views} of {planned} projections: {self._stop.reason}. The file can be used as "
                f"it is.{sentences}"
            )
        if self._epoch:
            raise EpochEndedError(
                f"{sentences.strip()} The file was closed before the end of the scan, because "
                f"{self._epoch}.{self._others}",
                self.missing,
            )
        if self.missing:
            raise LedgerError(f"{sentences.strip()}{self._others}", self.missing)

    @property
    def _others(self) -> str:
        if not self._views:
            return f" The file has {count(self._row, 'frame')}, but no projection with an angle."
        counted_from = "" if self._sorter.basis.is_sure else f", counted from {self._sorter.basis.value}"
        return f" All other frames are in the file, each with the angle of its number{counted_from}."


def seen_of(frame: ArrayFrame, guide: Guide, *, gone: bool = False) -> Seen:
    """The known facts about a frame.

    Args:
        gone: the connection to the server was lost since the previous frame.
    """
    return Seen(
        frame.unique_id, guide.phase(frame), frame.time, frame.kind, frame.payload, gone or frame.is_current, frame
    )
