"""FrameChecks: computes the statistics of the frames of a scan and runs the monitor's checks, in a separate thread.

If a check hangs, the thread that takes the checked frames continues alone, and the monitor is off.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from queue import Empty, Queue

from beamline.core.events import Sink, Warned
from beamline.core.stop import StopRequest
from beamline.monitor.check import Flag
from beamline.monitor.digest import FrameDigest, digests
from beamline.monitor.watch import Monitor, look_past_failures
from beamline.scan.backlog import CHECKED_FRAMES
from drivers.base.frame import Frame, FrameKind

CHECKS = 60.0  # real time in s of the checks of a frame after which they count as hanging
COMPILES = 300.0  # the same for the first frame of a kind, because checks may be compiled for it
STOPPED, ABORTED = 5.0, 1.0  # the same after a request to stop, and to abort
SLICE = 0.25  # real s: longest wait for space in a queue, or for a frame, between two checks of the stop request

QueueItem = Frame | Callable[[], object] | None
"""Items of the queue: a frame, a function that is called when its turn comes, or None after the last frame."""
Checked = tuple[Frame, FrameDigest, FrameDigest, tuple[Flag, ...] | None]
"""A frame, its digests for the checks and for the file, and its flags (None: the frame was not checked)."""
CheckedItem = Checked | BaseException | Callable[[], object] | None
"""A checked item. An exception: the statistics of the frame could not be computed."""


class FrameChecks:
    """Takes items from a queue, and gives them on in the same order, each frame with its statistics and flags.

    Args:
        next_item: function that waits for the next item.
        discards: function that returns True if frames are discarded, so that the queue does not stay full.

    Attributes:
        busy: time in s for which frames were checked.
    """

    def __init__(
        self, monitor: Monitor, preview_bin: int, next_item: Callable[[], QueueItem], discards: Callable[[], bool],
        stop: StopRequest, sink: Sink,
    ) -> None:  # fmt: skip
        self._monitor, self._preview_bin = monitor, preview_bin
        self._next_item, self._discards, self._stop, self._sink = next_item, discards, stop, sink
        self._monitor_off = False
        self.busy = 0.0
        self._checked: Queue[CheckedItem] = Queue(CHECKED_FRAMES)
        self._check_name = ""  # name of the check that is running, or ran last
        # protects the next two values, so that only one thread passes the frame on
        self._handing_over = threading.Lock()
        # the frame of this thread, and the time since which it has the frame
        self._frame_in_checks: tuple[Frame, float] | None = None
        self._without_thread = False  # the thread that takes the frames continues without this one
        self._compiled: set[FrameKind] = set()  # kinds of frames that were checked so far

    def start(self) -> None:
        """Start the thread."""
        threading.Thread(target=self._check_frames, name="recorder's checks", daemon=True).start()

    @property
    def idle(self) -> bool:
        """True if no checked item waits."""
        return self._checked.empty()

    def _check_frames(self) -> None:
        """The thread: computes statistics and checks frames, until the last frame, or until the other thread continues
        alone.
        """
        while (item := self._next_item()) is not None:
            if not isinstance(item, Frame):
                self._checked.put(item)
            elif not self._discards():
                self._frame_in_checks = item, time.monotonic()
                checked = self._digested(item)
                with self._handing_over:
                    if self._without_thread:
                        return
                    self._frame_in_checks = None
                self._compiled.add(item.kind)
                self._checked.put(checked)
        self._checked.put(None)

    def _begin_check(self, name: str) -> None:
        self._check_name = name

    def _digested(self, frame: Frame) -> CheckedItem:
        """A frame with its statistics and flags. If there was an error, the error is returned, and raised when the
        frame should be written.
        """
        start_time = time.monotonic()
        try:
            frame_digest, stored_digest = digests(frame.counts, self._monitor.context.saturation, self._preview_bin)
            return frame, frame_digest, stored_digest, self._flags_of(_as_stored(frame), frame_digest)
        except BaseException as error:
            return error
        finally:
            self.busy += time.monotonic() - start_time

    def next(self) -> CheckedItem:
        """The next checked item. If the checks hang, the thread that calls computes the statistics itself."""
        while True:
            with suppress(Empty):
                return self._checked.get(not self._without_thread, SLICE)
            if self._without_thread:
                item = self._next_item()
                return self._digested(item) if isinstance(item, Frame) else item
            self._give_up_checks_that_hang()

    def _give_up_checks_that_hang(self) -> None:
        """Switch the monitor off because it takes too long, and continue with its frame. The thread of the checks
        may hang for ever.
        """
        with self._handing_over:
            if self._frame_in_checks is None:
                return
            frame, since = self._frame_in_checks
            usual = CHECKS if frame.kind in self._compiled else COMPILES
            limit = ABORTED if self._stop.aborting else STOPPED if self._stop.stopping else usual
            if (seconds := time.monotonic() - since) <= limit:
                return
            self._monitor_off = self._without_thread = True
        self._sink(
            Warned(
                f"The monitor is off: its check {self._check_name} has not finished frame {frame.index} "
                f"for {seconds:.0f} s. From here on frames are stored without flags."
            )
        )
        self._checked.put(self._digested(frame))

    def _flags_of(self, frame: Frame, frame_digest: FrameDigest) -> tuple[Flag, ...] | None:
        """The flags of the monitor; None if the monitor is off. An error does not lose a frame: a check that raises an
        error is switched off, with a warning.
        """
        if self._monitor_off:
            return None
        try:
            self._monitor, flags, failures = look_past_failures(self._monitor, frame, frame_digest, self._begin_check)
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
