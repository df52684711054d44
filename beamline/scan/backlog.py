"""Backlog: computes how many frames may wait for the disk and the remaining time, and pauses a scan before memory or
disk is full.
"""

from __future__ import annotations

import math
import shutil
import time
from collections import deque
from contextlib import suppress
from pathlib import Path

import numpy as np

from beamline.core.events import FrameStored
from beamline.core.machine import free_memory
from beamline.core.stop import Cause, PauseRequest
from beamline.core.text import count, size
from beamline.plan.limits import CLOSING
from beamline.plan.plan import Timeline
from drivers.base.frame import Frame
from drivers.frame_memory import FrameMemory

WAITING_BYTES = 1_000_000_000  # memory for frames that wait to be written
WAITING_FRAMES = (4, 128)  # smallest and largest number of frames
CHECKED_FRAMES = 2  # largest number of frames that wait between the threads of the recorder
LOOK = 1.0  # real s between two checks of the free space
BRAKING = 5.0  # s for which frames may still come after a pause was requested
EVENT_INTERVAL = 0.1  # real s between `frame` events
RATE_FRAMES = 20  # number of last frames from which the rate is computed


def room(timeline: Timeline) -> int:
    """Number of frames that can wait to be written."""
    low, high = WAITING_FRAMES
    return min(max(WAITING_BYTES // timeline.frame_bytes, low), high)


def frames_in_memory(timeline: Timeline) -> int:
    """Largest number of frames in memory at a time: waiting, being written, and coming from the camera."""
    return min(room(timeline) + CHECKED_FRAMES + 4, timeline.n_frames)


def prepare_memory(memory: FrameMemory | None, timeline: Timeline, shape: tuple[int, int]) -> str:
    """Reserve memory, before the first frame comes, for the frames that may wait for the disk. Returns a sentence about
    the memory, or "" if no sentence is needed.

    At most a quarter of the free memory is reserved, because a live volume may use half of it.
    """
    n = min(frames_in_memory(timeline), free_memory() // (4 * timeline.frame_bytes))
    if memory is None or n == 0:
        return ""
    frames = f"Memory for {count(n, 'frame')} ({size(n * timeline.frame_bytes)})"
    try:
        memory.prepare(n, shape)
    except MemoryError:
        return f"{frames} cannot be reserved before the scan"
    return f"{frames} is reserved"


def hold_for_space(pause: PauseRequest, reserve: int, free: int, remaining: int) -> None:
    """Pause a scan before its disk is full. The pause lasts until twice the limit is free.

    Args:
        reserve: bytes that must stay free for frames that still come after the pause was requested. free: free bytes of
            the disk. remaining: bytes that must still be written.
    """
    enough = min(2 * reserve, remaining) + CLOSING
    if remaining and free < min(reserve, remaining) + CLOSING:
        pause.hold(
            Cause.SPACE,
            f"Free some space on the scan's disk: {size(free)} are free, and {size(remaining)} are still to be "
            f"written. The scan continues automatically when {size(enough)} are free",
        )
    elif not remaining or free >= enough:
        pause.release(Cause.SPACE)


def hold_for_backlog(pause: PauseRequest, limit: int, waiting: int, checking: float, writing: float) -> None:
    """Pause a fly scan before the queue is full. The pause lasts until only few frames wait to be written.

    Args:
        limit: limit for the number of waiting frames.
        waiting: number of waiting frames.
        checking, writing: time in s for which the threads of the recorder were busy. If writing took longer, the disk
            is too slow.
    """
    if 4 * waiting >= 3 * limit:
        cause, advice = (
            ("The disk is too slow", "a longer period_s or a faster disk")
            if writing > checking
            else (
                "The processor is too slow",
                "a longer period_s, a scan without live reconstruction, or fewer other programs",
            )
        )
        pause.hold(
            Cause.BACKLOG,
            f"{cause}: {waiting} of at most {limit} frames wait in memory. The scan pauses, and continues "
            f"automatically when most of these frames are written. To avoid such pauses, use {advice}",
        )
    elif 4 * waiting <= limit:
        pause.release(Cause.BACKLOG)


class DiskSpace:
    """Pauses a scan before its disk is full. It looks at the free space about once a second."""

    def __init__(self, pause: PauseRequest, folder: Path, timeline: Timeline) -> None:
        self._pause, self._folder, self._looked_at = pause, folder, -math.inf
        self._row_bytes = timeline.total_bytes // timeline.n_frames
        frames_while_braking = math.ceil(BRAKING / timeline.views.period) if timeline.views.trains else 1
        frames_in_threads = CHECKED_FRAMES + 2
        self._reserve = self._row_bytes * (room(timeline) + frames_in_threads + frames_while_braking)

    def look(self, n_left: int) -> None:
        """Look at the free space if the last look was longer ago than LOOK. `n_left` frames must still be written."""
        if time.monotonic() - self._looked_at > LOOK:
            self._looked_at = time.monotonic()
            with suppress(OSError):  # a failing disk ends the scan only when it does not accept a frame
                remaining = max(0, n_left) * self._row_bytes
                hold_for_space(self._pause, self._reserve, shutil.disk_usage(self._folder).free, remaining)


class FrameProgress:
    """Data of the `frame` event: frames written, rate, time left."""

    def __init__(self, timeline: Timeline) -> None:
        self.total, self._bytes = timeline.n_frames, timeline.frame_bytes
        # The time for moves is spread over the frames, so that the time left always decreases, also after a wait for
        # the operator.
        periods = np.concatenate([np.full(block.n_to_take, block.period) for block in timeline.blocks])
        self._ahead = timeline.duration * np.append(np.cumsum(periods[::-1])[::-1], 0.0) / periods.sum()
        self._times: deque[float] = deque(maxlen=RATE_FRAMES)
        self._last_event = -EVENT_INTERVAL

    def expect_more(self, done: int, n: int, seconds: float) -> None:
        """Add `n` frames that were not planned. They come after `done` frames and take `seconds`."""
        before, after = self._ahead[: done + 1] + seconds, self._ahead[done:]
        self._ahead = np.concatenate([before, np.linspace(before[-1], after[0], n + 1)[1:-1], after])
        self.total += n

    def expect_fewer(self, done: int, n: int) -> None:
        """Subtract `n` frames: the next `n` planned frames after `done` frames will not come."""
        first_remaining = min(done + n, self.total)
        self._ahead = np.append(
            self._ahead[:done] - self._ahead[done] + self._ahead[first_remaining], self._ahead[first_remaining:]
        )
        self.total -= first_remaining - done

    def update(self, frame: Frame, n: int, mean: float) -> FrameStored | None:
        """Record the n-th frame. Returns None if the last event was less than EVENT_INTERVAL ago."""
        self._times.append(frame.time)
        now = time.monotonic()
        if now - self._last_event < EVENT_INTERVAL and n < self.total:
            return None
        self._last_event = now
        span = self._times[-1] - self._times[0]
        rate = (len(self._times) - 1) / span if span > 0 else 0.0
        seconds = float(self._ahead[min(n, self.total)])
        return FrameStored(n, self.total, frame.kind.name.lower(), rate, rate * self._bytes / 1e6, seconds, mean)
