"""Recorder: computes statistics of every frame, checks the frame and writes it, all in separate threads, so that the
acquisition does not wait for the disk.

Two threads handle the frames in order. The first computes the statistics of a frame and runs the checks of the monitor,
while the second writes the previous frame. Both spend nearly all their time in code that releases the interpreter lock.
The monitor gets each frame in the form in which a reader of the file will get it, in blocks that do not depend on the
preview in the file. So `beamline monitor FILE` has the same findings. If a check hangs, the second thread continues
without the first.
"""

from __future__ import annotations

import math
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from queue import Empty, Full, Queue

from beamline.core.errors import BeamlineError, DataError, user_message
from beamline.core.events import Sink, Warned
from beamline.core.stop import PauseRequest, StopRequest
from beamline.core.text import count, spans
from beamline.monitor.check import Flag
from beamline.monitor.digest import FrameDigest, digests
from beamline.monitor.watch import Monitor, look_past_failures
from beamline.plan.plan import Timeline
from beamline.scan.backlog import CHECKED_FRAMES, FrameProgress, hold_for_backlog, hold_for_space, room
from beamline.scan.flagged import FlaggedFrames
from beamline.scan.references import ReferenceLog
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.frame import Frame, FrameKind

LOOK = 1.0  # real s between two checks of the free space
BRAKING = 5.0  # s for which frames may still come after a pause was requested
STALL = 60.0  # real time in s of a write after which the disk counts as dead
CHECKS = 60.0  # real time in s of the checks of a frame after which they count as hanging
COMPILES = 300.0  # the same for the first frame of a kind, because checks may be compiled for it
STOPPED, ABORTED = 5.0, 1.0  # the same after a request to stop, and to abort
SLICE = 0.25  # real s: longest wait for space in the queue, or for a frame, between two checks of the stop request

_Checked = tuple[Frame, FrameDigest, FrameDigest, tuple[Flag, ...] | None]
"""A frame, its digests for the checks and for the file, and its flags (None: the frame was not checked)."""
_Call = Callable[[], object]
_Item = _Checked | BaseException | _Call | None
"""Items for the second thread. An exception: the statistics of the frame could not be computed. A function: it is
called when its turn comes."""


class Recorder:
    """Records the frames that `put` gets. The monitor checks each frame, and the frame is written with its checksum and
    flags.

    Frames are flushed to the file if no frame waits. If frames wait, the writer decides how often it flushes.

    No frame is dropped: if the disk is too slow, `put` waits. A fly scan cannot wait for space, so it pauses before the
    queue is full. Every scan pauses before the disk is full. `put`, `check`, `wait` and `finish` raise DataError if a
    frame could not be written, or if a write takes longer than STALL. If checks hang, the monitor is switched off. A
    stop or an abort waits neither for the disk nor for the checks: frames that the camera still delivers are kept in
    memory.

    Args:
        flagged: object that gets the flags of each frame. pause: request that pauses the scan. stop: stop request of
            the scan.

    Attributes:
        n_frames: number of frames written so far. announced: number of frames beyond the timeline, from `expect_more`.
            references: the darks and flats so far. flagged: the flags so far.
    """

    def __init__(
        self,
        writer: NXtomoWriter,
        monitor: Monitor,
        timeline: Timeline,
        *,
        preview_bin: int,
        sink: Sink,
        flagged: FlaggedFrames | None = None,
        pause: PauseRequest | None = None,
        stop: StopRequest | None = None,
    ) -> None:
        self._writer, self._monitor, self._preview_bin = writer, monitor, preview_bin
        self._sink, self.flagged = sink, flagged or FlaggedFrames(sink)
        self._progress = FrameProgress(timeline)
        self._stop, self._pause = stop or StopRequest(), pause or PauseRequest()
        self._monitor_off = False
        self._unjudged: list[int] = []  # rows of frames that the monitor did not check
        self._check_name = ""  # name of the check that is running, or ran last
        self._handing = threading.Lock()  # protects the next two values, so that only one thread passes the frame on
        # the frame of the first thread, and the time since which it has the frame
        self._under_checks: tuple[Frame, float] | None = None
        self._alone = False  # the second thread continues without the first
        self._compiled: set[FrameKind] = set()  # kinds of frames that were checked so far
        self.n_frames = 0
        self._invalid: set[int] = set()  # rows that were invalid from the start
        self.announced, self._retaking = 0, False
        self.references = ReferenceLog()
        self._failure: BaseException | None = None
        self._checking = self._writing = 0.0  # time in s for which the threads were busy
        self._most, views = room(timeline), timeline.views
        self._waiting: Queue[Frame | _Call | None] = Queue(self._most)
        self._checked: Queue[_Item] = Queue(CHECKED_FRAMES)
        self._row_bytes = timeline.total_bytes // timeline.n_frames
        on_the_way = math.ceil(BRAKING / views.period) if views.trains else 1
        in_work = CHECKED_FRAMES + 2
        self._reserve = self._row_bytes * (self._most + in_work + on_the_way)
        # True if the projections are a fly scan; True while the stage flies
        self._flies, self._flying = bool(views.trains), False
        self._looked_at, self._writing_since = -math.inf, math.inf
        self._thread = threading.Thread(target=self._write_frames, name="recorder", daemon=True)
        self._thread.start()
        threading.Thread(target=self._check_frames, name="recorder's checks", daemon=True).start()

    def put(self, frame: Frame) -> None:
        """Queue a frame for writing. The call waits as long as the queue is full."""
        self._enqueue(frame)
        if frame.kind is not FrameKind.INVALID:  # invalid frames may come in any block
            self._flying = frame.kind is FrameKind.PROJECTION and not self._retaking
        self._look_at_backlog()
        self._raise_failure()

    def check(self) -> None:
        """Check whether the disk answers, at a time at which no frames come."""
        self._refuse_stall()
        self._raise_failure()

    def wait(self) -> None:
        """Wait until every frame that was given to `put` is written, or until a stop is requested."""
        reached = threading.Event()
        self._enqueue(reached.set)
        while not reached.wait(SLICE) and not self._stop.stopping:
            self.check()
        self._raise_failure()

    def end_pass(self) -> None:
        """If the scan makes decisions, record that the frames so far end a pass. (Projections that were taken again
        belong to this pass.)"""
        self._enqueue(self._writer.end_pass)
        if self._retaking:
            self.wait()
            self._retaking = False

    def add_decision(self, values: Mapping[str, object]) -> None:
        """If the scan makes decisions, record the choice after a pass (the values of its event)."""
        self._enqueue(lambda: self._writer.add_decision(values))
        self._enqueue(lambda: self._progress.expect_fewer(self.n_frames, int(str(values.get("dropped", 0)))))

    def finish(self) -> None:
        """Wait until all queued frames are written. No frame may be given to `put` afterwards."""
        self._enqueue(None)
        while self.hangs:
            self._refuse_stall()
            self._thread.join(SLICE)
        self._raise_failure()

    @property
    def unjudged(self) -> str:
        """Frames that the monitor has not checked, in words; "" if it has checked all so far."""
        if not self._unjudged:
            return ""
        frames = f"{count(len(self._unjudged), 'frame')} ({spans(self._unjudged)})"
        return (
            f"The monitor did not check {frames}: they have no flags. `beamline monitor {self._writer.path}` "
            "checks them."
        )

    def expect_more(self, n: int, seconds: float) -> None:
        """Announce frames beyond the timeline. Call this only when no frame waits."""
        self._retaking, self.announced = True, self.announced + n
        self._progress.expect_more(self.n_frames, n, seconds)

    @property
    def hangs(self) -> bool:
        """True if a frame is still being written. After `finish`, this means that the disk does not respond."""
        return self._thread.is_alive()

    def _enqueue(self, item: Frame | _Call | None) -> None:
        """Queue a frame, a function that is called when its turn comes, or None after the last frame."""
        while True:
            if self._stop.aborting or (self._stop.stopping and self._flying):
                self._waiting.maxsize = 0  # the stage turns with open shutter, so its frames come first
            try:
                self._waiting.put(item, timeout=SLICE)
            except Full:
                self._refuse_stall()
            else:
                return

    def _refuse_stall(self) -> None:
        if time.monotonic() - self._writing_since > STALL:
            raise DataError(f"Check the disk, because it accepted no frame for {STALL:g} s. {self._safe()}")

    def _raise_failure(self) -> None:
        cause = self._failure
        if isinstance(cause, BeamlineError):
            raise cause
        if cause is not None:
            raise DataError(
                f"A frame could not be written: {user_message(cause).rstrip('.')}. {self._safe()}"
            ) from cause

    def _safe(self) -> str:
        return f"The first {self._writer.safe} frames are safe in {self._writer.path}."

    def _check_frames(self) -> None:
        """The first thread: computes statistics and checks frames, until the last frame, or until the second thread
        continues alone.
        """
        while (item := self._next()) is not None:
            if not isinstance(item, Frame):
                self._checked.put(item)
            elif self._failure is None:  # after a failure, frames are discarded, so that `put` does not wait for space
                self._under_checks = item, time.monotonic()
                checked = self._digested(item)
                with self._handing:
                    if self._alone:
                        return
                    self._under_checks = None
                self._compiled.add(item.kind)
                self._checked.put(checked)
        self._checked.put(None)

    def _begin_check(self, name: str) -> None:
        self._check_name = name

    def _digested(self, frame: Frame) -> _Item:
        """A frame with its statistics and flags. If there was an error, the error is returned, and raised when the
        frame should be written.
        """
        begun = time.monotonic()
        try:
            seen, stored = digests(frame.counts, self._monitor.context.saturation, self._preview_bin)
            return frame, seen, stored, self._look(_as_stored(frame), seen)
        except BaseException as error:
            return error
        finally:
            self._checking += time.monotonic() - begun

    def _next_checked(self) -> _Item:
        """The next item of the second thread. If the checks hang, this thread computes the statistics itself."""
        while True:
            with suppress(Empty):
                return self._checked.get(not self._alone, SLICE)
            if self._alone:
                item = self._next()
                return self._digested(item) if isinstance(item, Frame) else item
            self._give_up_checks_that_hang()

    def _give_up_checks_that_hang(self) -> None:
        """Switch the monitor off because it takes too long, and continue with its frame. The first thread may hang for
        ever.
        """
        with self._handing:
            if self._under_checks is None:
                return
            frame, since = self._under_checks
            usual = CHECKS if frame.kind in self._compiled else COMPILES
            limit = ABORTED if self._stop.aborting else STOPPED if self._stop.stopping else usual
            if (seconds := time.monotonic() - since) <= limit:
                return
            self._monitor_off = self._alone = True
        self._sink(
            Warned(
                f"The monitor is off: its check {self._check_name} has not finished frame {frame.index} "
                f"for {seconds:.0f} s. From here on frames are stored without flags."
            )
        )
        self._checked.put(self._digested(frame))

    def _write_frames(self) -> None:
        """The second thread: writes frames and reports them."""
        item, flushed = self._next_checked(), True
        while True:
            begun = time.monotonic()
            try:
                if isinstance(item, BaseException):
                    raise item
                if self._failure is None:
                    self._writing_since = time.monotonic()
                    if isinstance(item, tuple):
                        self._write(*item)
                        flushed = False
                    nothing_waits = self._waiting.empty() and self._checked.empty()
                    if not flushed and (nothing_waits or not isinstance(item, tuple)):
                        self._writer.flush()
                        flushed = True
                if callable(item):
                    item()
            # a plug-in may raise SystemExit, which would end this thread without a message
            except BaseException as error:
                with suppress(BaseException):  # the first error counts
                    self._writer.flush()  # the frames before it
                self._failure = self._failure or error
            self._writing += time.monotonic() - begun
            self._writing_since = math.inf
            if item is None:
                return
            item = self._next_checked()

    def _next(self) -> Frame | _Call | None:
        """The next item of the queue. While it waits, it checks the disk about once a second."""
        while True:
            self._look_at_backlog()
            if time.monotonic() - self._looked_at > LOOK:
                self._looked_at = time.monotonic()
                with suppress(OSError):  # a failing disk ends the scan only when it does not accept a frame
                    remaining = max(0, self._progress.total - self.n_frames) * self._row_bytes
                    hold_for_space(
                        self._pause, self._reserve, shutil.disk_usage(self._writer.path.parent).free, remaining
                    )
            with suppress(Empty):
                return self._waiting.get(timeout=LOOK)

    def _look_at_backlog(self) -> None:
        if self._flies:
            hold_for_backlog(
                self._pause, self._most,
                self._waiting.qsize() if self._flying else 0,  # other frames wait in `put`
                self._checking, self._writing,
            )  # fmt: skip

    def _write(self, frame: Frame, seen: FrameDigest, stored: FrameDigest, flags: tuple[Flag, ...] | None) -> None:
        if flags is None:
            self._unjudged.append(frame.index)
            flags = ()
        self._writer.append(frame, stored, flags)
        self.references.add(frame, seen)
        self.n_frames += 1
        beside = frame.replaces >= 0 and frame.replaces not in self._invalid and not self._retaking
        if frame.kind is FrameKind.INVALID:
            self._invalid.add(frame.index)
        if frame.kind is FrameKind.INVALID or beside:
            # frames that were neither planned nor announced
            self._progress.expect_more(self.n_frames - 1, 1, frame.exposure)
        self.flagged.add(frame, flags)
        if (event := self._progress.update(frame, self.n_frames, seen.mean)) is not None:
            self._sink(event)

    def _look(self, frame: Frame, seen: FrameDigest) -> tuple[Flag, ...] | None:
        """The flags of the monitor; None if the monitor is off. An error does not lose a frame: a check that raises an
        error is switched off, with a warning.
        """
        if self._monitor_off:
            return None
        try:
            self._monitor, flags, failures = look_past_failures(self._monitor, frame, seen, self._begin_check)
        except BaseException as error:
            self._monitor_off = True
            self._sink(Warned(f"the monitor failed at frame {frame.index} and is off: {error!r}"))
            return None
        for failure in failures:
            self._sink(Warned(failure))
        return flags


def _as_stored(frame: Frame) -> Frame:
    """The frame in the form in which a reader of the file gets it. A file contains degrees; converted to radians, they
    differ in the last bit.

    This matters for a check that keeps a projection every 5°: it must choose the same projections now and later.
    """
    return replace(frame, angle=math.radians(math.degrees(frame.angle)))
