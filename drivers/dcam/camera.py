"""DcamCamera: a Hamamatsu camera over the DCAM-API; a ring of buffers, one copy out per frame, losses kept visible."""

from __future__ import annotations

import ctypes
import threading
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers import usb
from drivers.clock import Clock, SystemClock
from drivers.dcam import codes
from drivers.dcam.abi import BufFrame, Dcam, DcamError
from drivers.dcam.codes import CaptureMode, CaptureState, Error, Event, Property, Text
from drivers.dcam.properties import Properties
from drivers.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.protocols import CameraFrame, CameraSettings, CameraTiming, TriggerSource

_WAIT_SLICE = 0.1  # s; an event may fall between looking and waiting, so that no single wait may be long
_START_TIMEOUT = 5.0  # s
_LEAST_SLOTS = 16  # where memory allows: the camera may run on beyond the frames asked for while the host stalls


@dataclass
class _Capture:
    """One run of the ring. `next` is the number, from 0, of the frame to hand out next."""

    slots: int
    next: int = 0
    clock_offset: float | None = None  # s, host time minus the camera's


class DcamCamera:
    """A triggered Hamamatsu camera (ORCA-Quest); implements drivers.protocols.Camera.

    A lost frame stays visible: framestamps are the camera's own count, so that a frame lost anywhere leaves a gap; and
    `describe` says how many were overwritten in the ring before they were fetched, and how often the transport reported
    a loss. One thread takes frames; `disarm` may be called from another one and ends its wait.

    Args:
        library: path of the DCAM-API library; None takes the installed one. A process can have one session with it.
        index: which camera, where DCAM finds several.
        name: what errors call it.
        clock: dates the first frame of a run when it is fetched; the camera's clock gives the differences after it.
        ring_bytes: most memory for the ring; a full 16-bit frame of an ORCA-Quest has 18.9 MB.

    Raises:
        DeviceError: no library, no camera, or it does not deliver a test frame.
    """

    def __init__(
        self,
        library: Path | None,
        index: int = 0,
        name: str = "camera",
        *,
        clock: Clock | None = None,
        ring_bytes: int = 1 << 30,
    ) -> None:
        self.name = name
        self._clock = clock or SystemClock()
        self._ring_bytes = ring_bytes
        self._ring_lock = threading.Lock()  # held while slots are read or freed
        self._capture: _Capture | None = None
        self._overwritten = self._transport_losses = 0
        self._closed = False
        self._dcam = Dcam(library, name)
        with ExitStack() as undo:
            undo.callback(self._dcam.api_uninit)  # a session that failed to start must be ended too
            found = self._start_session()
            if index >= found:
                raise DeviceError(
                    name, f"there is no camera {index}", expected=f"an index below {found}, as DCAM found"
                )
            self._camera = self._dcam.dev_open(index)
            undo.callback(self._dcam.dev_close, self._camera)
            self._wait, supported = self._dcam.wait_open(self._camera)
            self._events = (Event.FRAMEREADY | Event.STOPPED) & supported
            undo.callback(self._dcam.wait_close, self._wait)
            self._properties = Properties(self._dcam, self._camera, name)
            self._first_stamp = self._stamp_of_a_first_frame()
            self._settings = self._properties.read()
            self._cleanup = undo.pop_all()

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Apply and read back: the exposure as the camera rounded it, all else as asked.

        Raises:
            DeviceRefused: the camera cannot, or it is armed; it has the settings that it had.
        """
        self._require_open()
        if self._capture is not None:
            raise DeviceRefused(self.name, "it is armed and takes no settings", advice="disarm() it first")
        try:
            self._properties.apply(settings)
        except DeviceRefused:
            self._properties.apply(self._settings)
            raise
        self._settings = self._properties.read()
        return self._settings

    @property
    def timing(self) -> CameraTiming:
        self._require_open()
        return self._properties.timing()

    def arm(self, n_frames: int) -> None:
        """Allocate the ring and start; when it returns, the camera takes triggers.

        Raises:
            DeviceRefused: it is armed already, or n_frames < 1.
        """
        self._require_open()
        if self._capture is not None:
            raise DeviceRefused(self.name, "it is armed already", advice="disarm() it first")
        if n_frames < 1:
            raise DeviceRefused(self.name, f"it cannot be armed for less than one frame ({n_frames})")
        # One slot more than frames: the oldest slot of a full ring may be half overwritten at any moment.
        fitting = self._ring_bytes // round(self._properties.get(Property.BUFFER_FRAMEBYTES))
        slots = max(2, min(max(n_frames + 1, _LEAST_SLOTS), fitting))
        with ExitStack() as undo:
            self._start(slots, CaptureMode.SEQUENCE, undo)
            undo.pop_all()
        self._overwritten = self._transport_losses = 0
        self._capture = _Capture(slots)

    def software_trigger(self) -> None:
        if self._capture is None or self._settings.trigger is not TriggerSource.SOFTWARE:
            armed = "not armed" if self._capture is None else "armed"
            problem = f"it takes no software trigger ({armed}, trigger {self._settings.trigger})"
            raise DeviceRefused(self.name, problem, advice="Configure the trigger as software and arm it")
        self._dcam.cap_firetrigger(self._camera)

    def next_frame(self, timeout: float) -> CameraFrame:
        """The oldest frame not yet taken, in memory of its own.

        Raises:
            DeviceTimeout: none came within `timeout` s.
            DeviceRefused: not armed, or disarmed while waiting.
            DeviceError: unplugged, or the capture ended by itself.
        """
        deadline = self._clock.now() + timeout
        while True:
            self._require_open()
            state = self._dcam.cap_status(self._camera)  # before looking into the ring, so that no last frame is missed
            frame = self._take()
            if frame is not None:
                return frame
            if state is not CaptureState.BUSY:
                problem = f"the capture ended by itself (state {state.name})"
                raise DeviceError(self.name, problem, advice="Check the camera's power and cable, then arm it again")
            left = deadline - self._clock.now()
            if left <= 0:
                problem = f"no frame came within {timeout:g} s of waiting for a trigger ({self._settings.trigger})"
                advice = "Check that triggers arrive, and no closer together than the camera's least period"
                raise DeviceTimeout(self.name, problem, advice=advice, state="It is still armed")
            self._await_event(min(left, _WAIT_SLICE))

    def disarm(self) -> None:
        """Stop and free the ring; legal in every state."""
        with self._ring_lock, ExitStack() as steps:
            if self._closed or self._capture is None:
                return
            self._capture = None
            # Run in reverse, the second even where the first fails: an unplugged camera still has memory to free.
            steps.callback(self._dcam.buf_release, self._camera)
            steps.callback(self._dcam.cap_stop, self._camera)

    def describe(self) -> dict[str, str | int | float]:
        """Identity, what the camera reports of its state, and the losses of the present or last run."""
        self._require_open()
        get = self._properties.get
        return {
            **{which.name.lower(): self._dcam.dev_getstring(self._camera, which) for which in Text},
            "exposure": get(Property.EXPOSURETIME),
            "trigger": str(self._settings.trigger),
            "readout": self._settings.readout,
            "binning": self._settings.binning,
            "sensor_temperature_c": get(Property.SENSORTEMPERATURE),
            "conversion_factor": get(Property.CONVERSIONFACTOR_COEFF),
            "conversion_offset": get(Property.CONVERSIONFACTOR_OFFSET),
            "defect_correction": "on" if get(Property.DEFECTCORRECT_MODE) == codes.ON else "off",
            "frames_overwritten": self._overwritten,
            "transport_losses": self._transport_losses,
        }

    def close(self) -> None:
        """Free everything; may be called again. A camera that no longer answers is let go without complaint."""
        if self._closed:
            return
        with suppress(DcamError):
            self.disarm()
        self._closed = True
        with suppress(DcamError):
            self._cleanup.close()

    def _require_open(self) -> None:
        if self._closed:
            raise DeviceError(self.name, "it is closed", advice="Connect again")

    def _start_session(self) -> int:
        try:
            return self._dcam.api_init()
        except DcamError as error:
            if error.code != Error.NOCAMERA:
                raise
            advice = f"Switch the camera on and check its cable. {usb.preflight().message}"
            reply = codes.error_name(error.code)
            raise DeviceError(self.name, "DCAM finds no camera", reply=reply, advice=advice) from error

    def _start(self, slots: int, mode: CaptureMode, undo: ExitStack) -> None:
        self._dcam.buf_alloc(self._camera, slots)
        undo.callback(self._dcam.buf_release, self._camera)
        self._dcam.cap_start(self._camera, mode)
        undo.callback(self._dcam.cap_stop, self._camera)
        deadline = self._clock.now() + _START_TIMEOUT
        # Triggers that come before BUSY are lost. A SNAP may be over already.
        while mode is CaptureMode.SEQUENCE and self._dcam.cap_status(self._camera) is not CaptureState.BUSY:
            if self._clock.now() > deadline:
                raise DeviceTimeout(self.name, f"the capture did not start within {_START_TIMEOUT:g} s")
            self._clock.sleep(0.001)

    def _stamp_of_a_first_frame(self) -> int:
        """0 or 1, as the model has it: without it, the loss of a run's first frame could not be seen."""
        self._properties.set_exactly(Property.TRIGGERSOURCE, codes.TRIGGERSOURCE_INTERNAL)
        deadline = self._clock.now() + _START_TIMEOUT
        with ExitStack() as undo:
            self._start(1, CaptureMode.SNAP, undo)
            while self._dcam.cap_transferinfo(self._camera) == 0:
                if self._clock.now() > deadline:
                    problem = f"no test frame came within {_START_TIMEOUT:g} s in free run"
                    raise DeviceTimeout(self.name, problem, advice="Check its cable, then switch it off and on")
                self._await_event(_WAIT_SLICE)
            return int(self._dcam.buf_lockframe(self._camera, 0).framestamp)

    def _await_event(self, seconds: float) -> None:
        """Wait for a reason to look into the ring again; what there is to see, the ring itself says."""
        try:
            self._dcam.wait_start(self._wait, self._events, max(1, round(seconds * 1000)))
        except DcamError as error:
            if error.code in (Error.LOSTFRAME, Error.MISSINGFRAME_TROUBLE):
                self._transport_losses += 1  # capture goes on; the framestamps show which frame is missing
            elif error.code != Error.TIMEOUT:
                raise

    def _take(self) -> CameraFrame | None:
        """The next frame of the ring, or None where there is none yet."""
        with self._ring_lock:
            capture = self._capture
            if capture is None:
                raise DeviceRefused(self.name, "it is not armed, so no frame will come", advice="arm() it first")
            while True:
                # The ring overwrites without asking. Frames older than its slots are gone, and the oldest one may go.
                count = self._dcam.cap_transferinfo(self._camera)
                oldest = count - capture.slots + 1
                self._overwritten += max(oldest - capture.next, 0)
                capture.next = max(capture.next, oldest)
                if capture.next >= count:
                    return None
                frame = self._dcam.buf_lockframe(self._camera, capture.next % capture.slots)
                counts = _copy(frame)
                if self._dcam.cap_transferinfo(self._camera) - capture.slots >= capture.next:
                    continue  # it may have been overwritten while it was copied
                capture.next += 1
                return CameraFrame(counts, frame.framestamp - self._first_stamp, self._host_time(capture, frame))

    def _host_time(self, capture: _Capture, frame: BufFrame) -> float:
        """Camera clocks start anywhere: the first frame is dated by the host, less its exposure and readout."""
        stamp = float(frame.timestamp.seconds + 1e-6 * frame.timestamp.microseconds)
        if capture.clock_offset is None:
            delay = self._settings.exposure + self._properties.get(Property.TIMING_READOUTTIME)
            capture.clock_offset = self._clock.now() - delay - stamp
        return capture.clock_offset + stamp


def _copy(frame: BufFrame) -> NDArray[np.uint16]:
    """uint16 [row, col] out of the ring; its rows may be padded."""
    rows, cols, stride = int(frame.height), int(frame.width), int(frame.row_bytes)
    memory = (ctypes.c_char * (stride * (rows - 1) + 2 * cols)).from_address(frame.buffer)
    return np.ndarray((rows, cols), dtype="<u2", buffer=memoryview(memory), strides=(stride, 2)).copy()
