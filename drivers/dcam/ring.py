"""Ring buffer: the frame buffers of the DCAM library during one capture; frames are read in order and copied once."""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import NDArray

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.dcam.abi import RUNTIME, Dcam
from drivers.dcam.codes import BufFrame, CaptureMode, CaptureState
from drivers.dcam.session import run_all
from drivers.frame_memory import FrameMemory

START_TIMEOUT = 5.0  # s that a camera may take to start a capture


class Ring:
    """A ring of frame buffers, allocated by the constructor and released by `free`. Not safe from several threads.

    Args:
        slots: number of frames in the ring. During a capture the oldest one may be half overwritten at any moment.
        memory: memory for the frames that are taken.

    Raises:
        DcamError: the memory cannot be allocated.

    Attributes:
        overwritten: frames that were overwritten before they were taken.
    """

    def __init__(self, dcam: Dcam, camera: int, device: str, slots: int, memory: FrameMemory) -> None:
        self._dcam, self._camera, self._device, self._slots = dcam, camera, device, slots
        self._next = 0  # number of the next frame to take, counted from 0 in the order of arrival
        self._count = 0  # frames that had arrived at the last call
        self._overrun_reported = False  # overwritten frames that have not been reported yet
        self.overwritten = 0
        self._memory = memory
        dcam.buf_alloc(camera, slots)

    def start(self, mode: CaptureMode, clock: Clock) -> None:
        """Start the capture; when this returns, the camera accepts triggers.

        Raises:
            DeviceTimeout: the camera did not start.
        """
        deadline = clock.now() + START_TIMEOUT
        self._dcam.cap_start(self._camera, mode)
        # Triggers before BUSY are lost. A SNAP capture may already have ended.
        while mode is CaptureMode.SEQUENCE and self.state() is not CaptureState.BUSY:
            if clock.now() > deadline:
                raise DeviceTimeout(
                    self._device,
                    f"the capture did not start within {START_TIMEOUT:g} s",
                    request="dcamcap_start",
                    reply=self.state().name,
                    expected="BUSY",
                    advice="Switch the camera off and on",
                    state="The camera is not armed, and no frame was taken",
                )
            clock.sleep(0.001)

    def state(self) -> CaptureState:
        return self._dcam.cap_status(self._camera)

    def arrived(self) -> int:
        """Number of frames that have arrived since the start.

        Raises:
            DeviceError: the count decreased, so the capture cannot continue.
        """
        before, self._count = self._count, self._dcam.cap_transferinfo(self._camera)
        if self._count < before:
            raise DeviceError(
                self._device,
                f"the frame counter of the camera decreased from {before} to {self._count}",
                request="dcamcap_transferinfo",
                expected="a counter that only increases during a capture",
                advice="Check that no other program uses the camera, then arm the camera again",
                state=f"{self._next} frames of this run were taken earlier",
            )
        return self._count

    def stamps(self, slot: int) -> BufFrame:
        """Stamps and layout of the frame in a slot; its pixels are not copied."""
        return self._dcam.buf_lockframe(self._camera, slot)

    def take(self) -> tuple[NDArray[np.uint16], BufFrame] | None:
        """A copy of the next frame, and its stamps; None if none has arrived yet.

        Raises:
            DeviceError: the ring was overrun. It is raised once; the next call continues with the remaining frames.
        """
        while True:
            # The ring overwrites frames that were not taken: the oldest slot may change at any moment.
            count = self.arrived()
            self._skip(count - self._slots + 1)
            if self._next >= count:
                return None
            frame = self._dcam.buf_lockframe(self._camera, self._next % self._slots)
            counts = self._copy(frame)
            if self.arrived() - self._slots >= self._next:
                continue  # the frame may have been overwritten during the copy
            self._next += 1
            self._overrun_reported = False
            return counts, frame

    def free(self) -> None:
        """Stop the capture and release the memory, also if stopping fails, because an unplugged camera still has
        memory."""
        run_all(lambda: self._dcam.cap_stop(self._camera), lambda: self._dcam.buf_release(self._camera))

    def _skip(self, oldest: int) -> None:
        first, lost = self._next, oldest - self._next
        if lost <= 0:
            return
        self._next = oldest
        self.overwritten += lost
        if not self._overrun_reported:
            self._overrun_reported = True
            last = oldest - 1
            raise DeviceError(
                self._device,
                f"the ring buffer of {self._slots} frames was overrun and {lost} frames are lost: frames {first} to "
                f"{last} of this run, in the order of arrival",
                expected="every frame to be read before the ring buffer overwrites it",
                advice="Read frames faster, trigger more slowly, or give the ring buffer more memory",
                state="Later frames can still be read",
            )

    def _copy(self, frame: BufFrame) -> NDArray[np.uint16]:
        """Copy a frame, uint16 [row, col], out of the ring, in which rows may be padded."""
        rows, cols, stride = int(frame.height), int(frame.width), int(frame.row_bytes)
        if not frame.buffer or rows < 1 or cols < 1 or stride < 2 * cols:
            problem = (
                f"the camera returned a frame with an impossible layout: {rows} x {cols} pixels, {stride} bytes per row"
            )
            raise DeviceError(
                self._device,
                problem,
                request="dcambuf_lockframe",
                expected="whole rows of 16-bit pixels",
                advice=f"{RUNTIME}, and that no other program changes the camera's settings",
                state=f"{self._next} frames of this run were taken earlier",
            )
        memory = (ctypes.c_char * (stride * (rows - 1) + 2 * cols)).from_address(frame.buffer)
        pixels = self._memory.take((rows, cols))
        pixels[:] = np.ndarray((rows, cols), dtype="<u2", buffer=memoryview(memory), strides=(stride, 2))
        return pixels


def seconds_of(frame: BufFrame) -> float:
    """Timestamp of a frame in s, counted from the camera's own epoch."""
    return float(frame.timestamp.seconds + 1e-6 * frame.timestamp.microseconds)


def require_stamps(first: BufFrame, second: BufFrame, device: str) -> None:
    """Check that the camera counted and timed two successive frames; otherwise a lost frame could not be detected.

    Raises:
        DeviceError: the framestamps do not differ by one, or the times do not increase.
    """
    if second.framestamp - first.framestamp == 1 and seconds_of(second) > seconds_of(first):
        return
    raise DeviceError(
        device,
        f"the frames have no usable counter and time: framestamps {first.framestamp}, "
        f"{second.framestamp}, times {seconds_of(first):.6f} s, {seconds_of(second):.6f} s",
        request="2 frames without triggers",
        expected="framestamps that differ by one, and increasing times; otherwise a lost frame cannot be detected",
        advice="Update the camera's firmware and the vendor's DCAM-API runtime",
        state="Nothing was measured",
    )
