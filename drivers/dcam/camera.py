"""DcamCamera: a Hamamatsu camera over the DCAM-API; a ring of buffers, one copy out per frame, losses kept visible."""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path

from drivers.clock import Clock, SystemClock
from drivers.dcam import cooling
from drivers.dcam.abi import DcamError
from drivers.dcam.codes import CaptureMode, CaptureState, Error, Property
from drivers.dcam.description import description
from drivers.dcam.options import DcamOptions, TriggerMode
from drivers.dcam.properties import Properties
from drivers.dcam.ring import START_TIMEOUT, Ring, require_stamps, seconds_of
from drivers.dcam.session import Session, run_all
from drivers.dcam.settings import apply_settings, apply_trigger_source, read_settings, read_timing
from drivers.dcam.structures import BufFrame
from drivers.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.protocols import CameraFrame, CameraSettings, CameraTiming, TriggerSource

_WAIT_SLICE = 0.1  # s; an event may fall between looking and waiting, so that no single wait may be long
_LEAST_SLOTS = 16  # where memory allows: the camera may run on beyond the frames asked for while the host stalls
_TEST_SETTINGS = CameraSettings(0.01, TriggerSource.INTERNAL)


class DcamCamera:
    """A triggered Hamamatsu camera (ORCA-Quest); implements drivers.protocols.Camera.

    A lost frame stays visible: framestamps are the camera's own count, so that a frame lost anywhere leaves a gap. A
    ring that was overrun is an error besides, and `describe` says how many frames it cost and how often the transport
    reported a loss. Triggers that come too early leave nothing at all: only times tell. So it is with the loss of a
    first frame where framestamps go on over captures, which is found out at the start. One thread takes frames;
    `disarm` and `close` may be called from another one and end its wait.

    Args:
        library: path of the DCAM-API library; None takes the installed one. A process can have one session with it.
        index: which camera, where DCAM finds several.
        name: what errors call it.
        clock: dates the first frame of a run when it is fetched; the camera's clock gives the differences after it.
        options: how it takes triggers, what it does to its counts, and the memory of its ring.

    Raises:
        DeviceError: no library, no camera, or it does not deliver two test frames that it counts.
    """

    def __init__(
        self,
        library: Path | None,
        index: int = 0,
        name: str = "camera",
        *,
        clock: Clock | None = None,
        options: DcamOptions | None = None,
    ) -> None:
        self.name = name
        self._clock, self._options = clock or SystemClock(), options or DcamOptions()
        self._inside = threading.Lock()  # held by whoever takes a frame: close() waits for it
        self._ring_lock = threading.Lock()  # held while slots are read or freed
        self._ring: Ring | None = None  # armed
        self._held: Ring | None = None  # in the library's memory, also one that could not be freed
        self._clock_offset: float | None = None  # s, host time minus the camera's, in this run
        self._origin: int | None = None  # framestamp of this run's first trigger; None until a frame tells
        self._overwritten, self._transport_losses = 0, 0
        self._closed = False
        self._session = Session(library, index, name)
        try:
            self._dcam, self._camera = self._session.dcam, self._session.camera
            self._properties = Properties(self._dcam, self._camera, name)
            self._apply(_TEST_SETTINGS)  # another program may have left anything
            stamps = self._stamp_of_a_first_frame(), self._stamp_of_a_first_frame()
            self._first_stamp = stamps[0] if stamps[0] == stamps[1] else None
        except BaseException:
            with suppress(DcamError):
                self._session.close()
            raise

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Apply and read back: the exposure as the camera rounded it, all else as asked.

        Raises:
            DeviceRefused: the camera cannot, or it is armed; it has the settings that it had.
        """
        self._require_open()
        if self._ring is not None:
            raise DeviceRefused(self.name, "it is armed and takes no settings", advice="disarm() it first")
        before = self._settings
        try:
            self._apply(settings)
        except DeviceRefused:
            self._apply(before)
            raise
        return self._settings

    @property
    def timing(self) -> CameraTiming:
        self._require_open()
        return read_timing(self._properties, self._settings.trigger, self._options)

    def arm(self, n_frames: int) -> None:
        """Allocate the ring and start; when it returns, the camera takes triggers.

        Raises:
            DeviceRefused: it is armed already, or n_frames < 1.
        """
        self._require_open()
        if self._ring is not None:
            raise DeviceRefused(self.name, "it is armed already", advice="disarm() it first")
        if n_frames < 1:
            raise DeviceRefused(self.name, f"it cannot be armed for less than one frame ({n_frames})")
        self.disarm()  # a ring that could not be freed
        if self._options.trigger_mode is TriggerMode.START:
            apply_trigger_source(self._properties, self._settings.trigger)
        # One slot more than frames: the oldest slot of a full ring may be half overwritten at any moment.
        fitting = self._options.ring_bytes // round(self._properties.get(Property.BUFFER_FRAMEBYTES))
        slots = max(2, min(max(n_frames + 1, _LEAST_SLOTS), fitting))
        ring = self._start(slots, CaptureMode.SEQUENCE)
        self._overwritten, self._transport_losses, self._clock_offset = 0, 0, None
        self._origin = self._first_stamp
        self._ring = ring

    def software_trigger(self) -> None:
        if self._ring is None or self._settings.trigger is not TriggerSource.SOFTWARE:
            armed = "not armed" if self._ring is None else "armed"
            problem = f"it takes no software trigger ({armed}, trigger {self._settings.trigger})"
            raise DeviceRefused(self.name, problem, advice="Configure the trigger as software and arm it")
        self._dcam.cap_firetrigger(self._camera)

    def next_frame(self, timeout: float) -> CameraFrame:
        """The oldest frame not yet taken, in memory of its own.

        Raises:
            DeviceTimeout: none came within `timeout` s.
            DeviceRefused: not armed, or disarmed while waiting.
            DeviceError: the ring was overrun (later frames can still be taken), the camera is unplugged, or the capture
                ended by itself.
        """
        deadline = self._clock.now() + timeout
        while True:
            with self._inside:
                frame = self._look()
                if frame is not None:
                    return frame
                left = deadline - self._clock.now()
                if left <= 0:
                    problem = f"no frame came within {timeout:g} s of waiting for a trigger ({self._settings.trigger})"
                    advice = "Check that triggers arrive, and no closer together than the camera's least period"
                    raise DeviceTimeout(self.name, problem, advice=advice, state="It is still armed")
                self._await_event(min(left, _WAIT_SLICE))

    def disarm(self) -> None:
        """Stop and free the ring; legal in every state, and another thread's wait for a frame ends.

        Raises:
            DcamError: the library cannot; calling again tries again.
        """
        if not self._closed:
            self._free()

    def wait_until_cold(self, timeout: float, progress: cooling.Progress = lambda celsius, status: None) -> float:
        """Wait until the sensor has the temperature that the cooler holds; °C.

        Args:
            timeout: s.
            progress: takes the temperature and the cooler's status, once a second.

        Raises:
            DeviceRefused: the cooler is off.
            DeviceTimeout: it was not cold in time.
            DeviceError: the cooler reports trouble.
        """
        self._require_open()
        return cooling.wait_until_cold(self._properties, self.name, self._clock, timeout, progress)

    def describe(self) -> dict[str, str | int | float]:
        """Identity, what the camera reports of its state, and the losses of the present or last run."""
        self._require_open()
        return {
            **description(self._session, self._properties, self._settings, self._options),
            "frames_overwritten": self._overwritten,
            "transport_losses": self._transport_losses,
            "framestamps_begin_anew": "no" if self._first_stamp is None else "yes",
        }

    def close(self) -> None:
        """Free everything, also after a failure; may be called again.

        Raises:
            DcamError: the first thing that failed. A camera that is not connected any more is let go without complaint.
        """
        if self._closed:
            return
        self._closed = True
        run_all(self._free, self._end)

    def _require_open(self) -> None:
        if self._closed:
            raise DeviceError(self.name, "it is closed", advice="Connect again")

    def _apply(self, settings: CameraSettings) -> None:
        apply_settings(self._properties, self.name, settings, self._options)
        self._settings = read_settings(self._properties, settings.trigger)

    def _free(self) -> None:
        with self._ring_lock:
            held, self._ring = self._held, None
            if held is not None:
                run_all(lambda: self._dcam.wait_abort(self._session.wait), held.free)
                self._held = None

    def _end(self) -> None:
        with self._inside:
            self._session.close()

    def _start(self, slots: int, mode: CaptureMode) -> Ring:
        """A ring that captures; it is held until `_free`, also after an error."""
        ring = self._held = Ring(self._dcam, self._camera, self.name, slots)
        try:
            ring.start(mode, self._clock)
        except BaseException:
            with suppress(DcamError):
                self._free()
            raise
        return ring

    def _stamp_of_a_first_frame(self) -> int:
        """0 or 1, as the model has it: without it, the loss of a run's first frame could not be seen."""
        ring = self._start(2, CaptureMode.SNAP)
        deadline = self._clock.now() + START_TIMEOUT
        while ring.arrived() < 2:
            if self._clock.now() > deadline:
                raise DeviceTimeout(
                    self.name,
                    f"{ring.arrived()} of 2 test frames came within {START_TIMEOUT:g} s in free run",
                    expected=f"2 frames of {_TEST_SETTINGS.exposure:g} s",
                    advice="Check its cable, then switch it off and on",
                    state="Nothing was measured",
                )
            self._await_event(_WAIT_SLICE)
        first, second = ring.stamps(0), ring.stamps(1)
        self._free()
        require_stamps(first, second, self.name)
        return int(first.framestamp)

    def _await_event(self, seconds: float) -> None:
        """Wait for a reason to look into the ring again; what there is to see, the ring itself says."""
        try:
            self._dcam.wait_start(self._session.wait, self._session.events, max(1, round(seconds * 1000)))
        except DcamError as error:
            if error.code in (Error.LOSTFRAME, Error.MISSINGFRAME_TROUBLE):
                self._transport_losses += 1  # capture goes on; the framestamps show which frame is missing
            elif error.code not in (Error.TIMEOUT, Error.ABORT):
                raise

    def _look(self) -> CameraFrame | None:
        """The next frame of the ring, or None where there is none yet."""
        self._require_open()
        with self._ring_lock:
            ring = self._ring
            if ring is None:
                raise DeviceRefused(self.name, "it is not armed, so no frame will come", advice="arm() it first")
            state = ring.state()  # before looking into the ring, so that no last frame is missed
            try:
                taken = ring.take()
            finally:
                self._overwritten = ring.overwritten
        if taken is not None:
            counts, frame = taken
            if self._origin is None:
                self._origin = frame.framestamp
            return CameraFrame(counts, frame.framestamp - self._origin, self._trigger_time(frame))
        if state is not CaptureState.BUSY:
            problem = f"the capture ended by itself (state {state.name})"
            raise DeviceError(
                self.name,
                problem,
                request="dcamcap_status",
                reply=state.name,
                expected="BUSY until it is disarmed",
                advice="Check the camera's power and cable, then arm it again",
                state="Frames taken before are good",
            )
        return None

    def _trigger_time(self, frame: BufFrame) -> float:
        """Camera clocks start anywhere: the first frame is dated by the host, less its exposure and readout."""
        stamp = seconds_of(frame)
        if self._clock_offset is None:
            delay = self._settings.exposure + self._properties.get(Property.TIMING_READOUTTIME)
            self._clock_offset = self._clock.now() - delay - stamp
        external = self._settings.trigger is TriggerSource.EXTERNAL
        return self._clock_offset + stamp - (self._options.trigger_delay if external else 0.0)
