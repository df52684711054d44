"""Needs: disk and memory that a planned scan needs, computed from its timeline."""

from __future__ import annotations

import math
from dataclasses import dataclass

from beamline.plan.limits import ROOM
from beamline.plan.plan import Timeline
from beamline.scan.preflight import DryRun
from beamline.scan.recorder import WAITING_BYTES, WAITING_FRAMES


@dataclass(frozen=True)
class ScanNeeds:
    """The disk and memory that a scan needs.

    Attributes:
        stretches: (bytes to write, duration in s) of each block.
        waiting_bytes: memory for frames that wait for the disk.
        ring_bytes: memory of the camera's ring; 0 for a simulated one.
        file_bytes: size of the file and the margin that a scan needs beside it.
    """

    stretches: tuple[tuple[int, float], ...]
    waiting_bytes: int
    ring_bytes: int
    file_bytes: int

    @property
    def rate(self) -> float:
        """Bytes/s at the highest frame rate."""
        return max(size / seconds for size, seconds in self.stretches)

    @property
    def memory(self) -> int:
        return self.waiting_bytes + self.ring_bytes

    def backlog(self, rate: float) -> float:
        """The largest number of bytes that wait for a disk of `rate` bytes/s."""
        most = waiting = 0.0
        for size, seconds in self.stretches:
            waiting = max(waiting + size - rate * seconds, 0.0)
            most = max(most, waiting)
        return most


def needs(worked: DryRun, ring_bytes: int) -> ScanNeeds:
    """The needs of a planned scan.

    Args:
        ring_bytes: memory of the camera's ring buffer.
    """
    timeline = worked.timeline
    per_row = timeline.total_bytes // timeline.n_frames
    return ScanNeeds(
        stretches=tuple((block.n * per_row, block.n * block.period) for block in timeline.blocks),
        waiting_bytes=waiting_frames(timeline.frame_bytes) * timeline.frame_bytes,
        ring_bytes=ring_bytes,
        file_bytes=math.ceil(timeline.total_bytes * ROOM),
    )


def waiting_frames(frame_bytes: int) -> int:
    """The largest number of frames that may wait to be written."""
    low, high = WAITING_FRAMES
    return min(max(WAITING_BYTES // frame_bytes, low), high)


def ring_bytes(timeline: Timeline, most: int) -> int:
    """Memory of the camera's ring buffer for the longest block, at most `most` bytes. One slot more than frames and at
    least 16, like the driver."""
    frames = max(block.n for block in timeline.blocks)
    slots = max(2, min(max(frames + 1, 16), most // timeline.frame_bytes))
    return slots * timeline.frame_bytes
