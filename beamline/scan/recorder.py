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
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from queue import Empty, Full, Queue

from beamline.core.errors import BeamlineError, DataError, user_message
from beamline.core.events import Sink
from beamline.core.stop import PauseRequest, StopRequest
from beamline.monitor.check import Flag
from beamline.monitor.digest import FrameDigest
from beamline.monitor.watch import Monitor
from beamline.plan.plan import Timeline
from beamline.scan import backlog
from beamline.scan.backlog import DiskSpace, FrameProgress, hold_for_backlog, room
from beamline.scan.flagged import FlaggedFrames
from beamline.scan.frame_checks import SLICE, FrameChecks, QueueItem
from beamline.scan.references import ReferenceLog
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.frame import Frame, FrameKind

STALL = 60.0  # real time in s of a write after which the disk counts as dead


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
        self._writer, self._sink, self.flagged = writer, sink, flagged or FlaggedFrames(sink)
        self._progress = FrameProgress(timeline)
        self._stop, self._pause = stop or StopRequest(), pause or PauseRequest()
        self.n_frames = 0
        self._invalid: set[int] = set()  # rows that were invalid from the start
        self.announced, self._retaking = 0, False
        self.references = ReferenceLog()
        self._failure: BaseException | None = None
        self._write_seconds = 0.0  # time in s for which the second thread was busy
        self._queue_limit = room(timeline)
        self._waiting: Queue[QueueItem] = Queue(self._queue_limit)
        self._space = DiskSpace(self._pause, writer.path.parent, timeline)
        # True if the projections are a fly scan; True while the stage flies
        self._is_fly_scan, self._flying = bool(timeline.views.trains), False
        self._writing_since = math.inf
        self._checks = FrameChecks(monitor, preview_bin, self._next, self._fails, self._stop, sink)
        self._thread = threading.Thread(target=self._write_frames, name="recorder", daemon=True)
        self._thread.start()
        self._checks.start()

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

    def expect_more(self, n: int, seconds: float) -> None:
        """Announce frames beyond the timeline. Call this only when no frame waits."""
        self._retaking, self.announced = True, self.announced + n
        self._progress.expect_more(self.n_frames, n, seconds)

    @property
    def hangs(self) -> bool:
        """True if a frame is still being written. After `finish`, this means that the disk does not respond."""
        return self._thread.is_alive()

    def _enqueue(self, item: QueueItem) -> None:
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
            raise DataError(f"Check the disk, because it accepted no frame for {STALL:g} s. {self._safe_sentence()}")

    def _raise_failure(self) -> None:
        cause = self._failure
        if isinstance(cause, BeamlineError):
            raise cause
        if cause is not None:
            reason = user_message(cause).rstrip(".")
            raise DataError(f"A frame could not be written: {reason}. {self._safe_sentence()}") from cause

    def _fails(self) -> bool:
        return self._failure is not None

    def _safe_sentence(self) -> str:
        return f"The first {self._writer.safe} frames are safe in {self._writer.path}."

    def _write_frames(self) -> None:
        """The second thread: writes frames and reports them."""
        item, flushed = self._checks.next(), True
        while True:
            start_time = time.monotonic()
            try:
                if isinstance(item, BaseException):
                    raise item
                if self._failure is None:
                    self._writing_since = time.monotonic()
                    if isinstance(item, tuple):
                        self._write(*item)
                        flushed = False
                    nothing_waits = self._waiting.empty() and self._checks.idle
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
            self._write_seconds += time.monotonic() - start_time
            self._writing_since = math.inf
            if item is None:
                return
            item = self._checks.next()

    def _next(self) -> QueueItem:
        """The next item of the queue. While it waits, it checks the disk about once a second."""
        while True:
            self._look_at_backlog()
            self._space.look(self._progress.total - self.n_frames)
            with suppress(Empty):
                return self._waiting.get(timeout=backlog.LOOK)

    def _look_at_backlog(self) -> None:
        if self._is_fly_scan:
            hold_for_backlog(
                self._pause, self._queue_limit,
                self._waiting.qsize() if self._flying else 0,  # other frames wait in `put`
                self._checks.busy, self._write_seconds,
            )  # fmt: skip

    def _write(
        self, frame: Frame, frame_digest: FrameDigest, stored_digest: FrameDigest, flags: tuple[Flag, ...] | None
    ) -> None:
        self._writer.append(frame, stored_digest, flags or ())
        self.references.add(frame, frame_digest)
        self.n_frames += 1
        unplanned = frame.replaces >= 0 and frame.replaces not in self._invalid and not self._retaking
        if frame.kind is FrameKind.INVALID:
            self._invalid.add(frame.index)
        if frame.kind is FrameKind.INVALID or unplanned:
            # frames that were neither planned nor announced
            self._progress.expect_more(self.n_frames - 1, 1, frame.exposure)
        self.flagged.add(frame, flags)
        if (event := self._progress.update(frame, self.n_frames, frame_digest.mean)) is not None:
            self._sink(event)
