"""Stamps of frames: the camera's own count and time, without which a lost frame could not be seen."""

from __future__ import annotations

from drivers.dcam.structures import BufFrame
from drivers.errors import DeviceError


def seconds_of(frame: BufFrame) -> float:
    """The camera's own time of a frame in s, from an epoch of its own."""
    return float(frame.timestamp.seconds + 1e-6 * frame.timestamp.microseconds)


def require_stamps(first: BufFrame, second: BufFrame, device: str) -> None:
    """Look whether two frames that followed each other were counted and dated.

    Raises:
        DeviceError: they were not.
    """
    if second.framestamp - first.framestamp == 1 and seconds_of(second) > seconds_of(first):
        return
    raise DeviceError(
        device,
        f"it does not count and date its frames: framestamps {first.framestamp}, {second.framestamp}, "
        f"times {seconds_of(first):.6f} s, {seconds_of(second):.6f} s",
        request="2 frames in free run",
        expected="framestamps one apart and times that grow, without which a lost frame cannot be seen",
        advice="Update the camera's firmware and the vendor's DCAM-API runtime",
        state="Nothing was measured",
    )
