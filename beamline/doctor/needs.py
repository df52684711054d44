"""Needs: what a planned scan asks of disk and memory, worked out from its timeline."""

from __future__ import annotations

import math
from dataclasses import dataclass

from beamline.plan.limits import ROOM
from beamline.plan.plan import Timeline
from beamline.scan.preflight import DryRun
from beamline.scan.recorder import WAITING_BYTES, WAITING_FRAMES


@dataclass(frozen=True)
class Needs:
    """A scan's needs.

    Attributes:
        stretches: bytes to write and s in which they come, block after block.
        waiting_bytes: memory for frames that wait for the disk.
        ring_bytes: memory of the camera's ring; 0 for a simulated one.
        file_bytes: the file, with the room that a scan demands beside it.
    """

    stretches: tuple[tuple[int, float], ...]
    waiting_bytes: int
    ring_bytes: int
    file_bytes: int

    @property
    def rate(self) -> float:
        """Bytes/s while frames come fastest."""
        return max(size / seconds for size, seconds in self.stretches)

    @property
    def memory(self) -> int:
        return self.waiting_bytes + self.ring_bytes

    def backlog(self, rate: float) -> float:
        """Most bytes that ever wait for a disk of `rate` bytes/s."""
        most = waiting = 0.0
        for size, seconds in self.stretches:
            waiting = max(waiting + size - rate * seconds, 0.0)
            most = max(most, waiting)
        return most


def needs(worked: DryRun, ring_bytes: int) -> Needs:
    """Of a scan that was worked out.

    Args:
        ring_bytes: what the camera's ring takes.
    """
    timeline = worked.timeline
    per_row = timeline.total_bytes // timeline.n_frames
    return Needs(
        stretches=tuple((block.n * per_row, block.n * block.period) for block in timeline.blocks),
        waiting_bytes=waiting_frames(timeline.frame_bytes) * timeline.frame_bytes,
        ring_bytes=ring_bytes,
        file_bytes=math.ceil(timeline.total_bytes * ROOM),
    )


def waiting_frames(frame_bytes: int) -> int:
    """How many frames may wait to be written."""
    low, high = WAITING_FRAMES
    return min(max(WAITING_BYTES // frame_bytes, low), high)


def ring_bytes(timeline: Timeline, most: int) -> int:
    """Of the camera's ring for the longest block: a slot more than frames and never less than 16 (as the driver does
    it), as far as `most` bytes go."""
    frames = max(block.n for block in timeline.blocks)
    slots = max(2, min(max(frames + 1, 16), most // timeline.frame_bytes))
    return slots * timeline.frame_bytes
