"""Ring: the library's ring of buffers during one capture, from its start, drained in order with one copy a frame."""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import NDArray

from drivers.clock import Clock
from drivers.dcam.abi import RUNTIME, Dcam
from drivers.dcam.codes import CaptureMode, CaptureState
from drivers.dcam.session import run_all
from drivers.dcam.structures import BufFrame
from drivers.errors import DeviceError, DeviceTimeout

START_TIMEOUT = 5.0
"""s that a camera may take to begin a capture."""


class Ring:
    """Allocated once made, until `free`. Not safe from several threads.

    Args:
        slots: frames that it holds; while it runs, the oldest one may be half overwritten at any moment.

    Raises:
        DcamError: there is no memory.

    Attributes:
        overwritten: frames that were overwritten before they were taken.
    """

    def __init__(self, dcam: Dcam, camera: int, device: str, slots: int) -> None:
        self._dcam, self._camera, self._device, self._slots = dcam, camera, device, slots
        self._next = 0  # number, from 0 in the order of arrival, of the frame to hand out next
        self._count = 0  # frames that had arrived when it was last looked at
        self._told = False  # an overrun was reported, and no frame was handed out since
        self.overwritten = 0
        dcam.buf_alloc(camera, slots)

    def start(self, mode: CaptureMode, clock: Clock) -> None:
        """Begin to capture; when it returns, triggers are taken.

        Raises:
            DeviceTimeout: the camera did not begin.
        """
        deadline = clock.now() + START_TIMEOUT
        self._dcam.cap_start(self._camera, mode)
        # Triggers that come before BUSY are lost. A SNAP may be over already.
        while mode is CaptureMode.SEQUENCE and self.state() is not CaptureState.BUSY:
            if clock.now() > deadline:
                raise DeviceTimeout(
                    self._device,
                    f"the capture did not start within {START_TIMEOUT:g} s",
                    request="dcamcap_start",
                    reply=self.state().name,
                    expected="BUSY",
                    advice="Switch the camera off and on",
                    state="It is not armed, and no frame was taken",
                )
            clock.sleep(0.001)

    def state(self) -> CaptureState:
        return self._dcam.cap_status(self._camera)

    def arrived(self) -> int:
        """Frames put into it so far.

        Raises:
            DeviceError: fewer than before. The count has 32 bits; one that was set back would be waited for in vain.
        """
        before, self._count = self._count, self._dcam.cap_transferinfo(self._camera)
        if self._count < before:
            raise DeviceError(
                self._device,
                f"its count of frames went back from {before} to {self._count}",
                request="dcamcap_transferinfo",
                expected="a count that only grows while a capture runs",
                advice="Check that no other program uses the camera, then arm it again",
                state=f"{self._next} frames of this run were taken before",
            )
        return self._count

    def stamps(self, slot: int) -> BufFrame:
        """What is known of the frame in a slot, without its pixels."""
        return self._dcam.buf_lockframe(self._camera, slot)

    def take(self) -> tuple[NDArray[np.uint16], BufFrame] | None:
        """The next frame, in memory of its own, and its stamps; None where there is none yet.

        Raises:
            DeviceError: it was overrun. Said once until a later frame is taken, so that taking goes on.
        """
        while True:
            # The ring overwrites without asking. Frames older than its slots are gone, and the oldest one may go.
            count = self.arrived()
            self._skip(count - self._slots + 1)
            if self._next >= count:
                return None
            frame = self._dcam.buf_lockframe(self._camera, self._next % self._slots)
            counts = self._copy(frame)
            if self.arrived() - self._slots >= self._next:
                continue  # it may have been overwritten while it was copied
            self._next += 1
            self._told = False
            return counts, frame

    def free(self) -> None:
        """Stop and release, the second even where the first fails: an unplugged camera still has memory to free."""
        run_all(lambda: self._dcam.cap_stop(self._camera), lambda: self._dcam.buf_release(self._camera))

    def _skip(self, oldest: int) -> None:
        first, lost = self._next, oldest - self._next
        if lost <= 0:
            return
        self._next = oldest
        self.overwritten += lost
        if not self._told:
            self._told = True
            raise DeviceError(
                self._device,
                f"its ring of {self._slots} frames was overrun and {lost} frames are lost: numbers {first} to "
                f"{oldest - 1} of this run in the order of arrival",
                expected="frames taken before the ring comes round",
                advice="Take frames faster, trigger slower or give the ring more memory",
                state="Later frames can still be taken",
            )

    def _copy(self, frame: BufFrame) -> NDArray[np.uint16]:
        """uint16 [row, col] out of the ring; its rows may be padded."""
        rows, cols, stride = int(frame.height), int(frame.width), int(frame.row_bytes)
        if not frame.buffer or rows < 1 or cols < 1 or stride < 2 * cols:
            problem = f"it gives a frame that cannot be: {rows} x {cols} pixels, {stride} bytes a row"
            raise DeviceError(
                self._device,
                problem,
                request="dcambuf_lockframe",
                expected="whole rows of 16-bit pixels",
                advice=f"{RUNTIME}, and that no other program sets the camera",
                state=f"{self._next} frames of this run were taken before",
            )
        memory = (ctypes.c_char * (stride * (rows - 1) + 2 * cols)).from_address(frame.buffer)
        return np.ndarray((rows, cols), dtype="<u2", buffer=memoryview(memory), strides=(stride, 2)).copy()


def seconds_of(frame: BufFrame) -> float:
    """Timestamp of a frame in s, from an epoch of the camera's own."""
    return float(frame.timestamp.seconds + 1e-6 * frame.timestamp.microseconds)


def require_stamps(first: BufFrame, second: BufFrame, device: str) -> None:
    """Check that the camera counted and dated two successive frames: without that, a lost frame could not be seen.

    Raises:
        DeviceError: the framestamps are not one apart, or the times do not grow.
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
