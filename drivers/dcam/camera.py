"""DcamCamera: a Hamamatsu camera over the DCAM-API, with a ring buffer, one copy per frame, and detection of lost
frames.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

from drivers.base.clock import Clock, SystemClock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import CameraFrame, CameraSettings, CameraTiming, TriggerSource
from drivers.dcam.abi import DcamError
from drivers.dcam.codes import BufFrame, CaptureMode, CaptureState, Error, Property
from drivers.dcam.properties import Progress, Properties, wait_until_cold
from drivers.dcam.ring import START_TIMEOUT, Ring, require_stamps, seconds_of
from drivers.dcam.session import Session, run_all
from drivers.dcam.settings import apply_settings, apply_trigger_source, description, read_settings, read_timing
from drivers.frame_memory import FrameMemory
from drivers.orca_quest import DcamOptions, TriggerMode

_WAIT_SLICE = 0.1  # s; short, because an event between a check and the wait would be missed
_LEAST_SLOTS = 16  # number of slots if there is enough memory, so that frames can arrive while the host is busy
_TEST_SETTINGS = CameraSettings(0.01, TriggerSource.INTERNAL)


class DcamCamera:
    """A triggered Hamamatsu camera (ORCA-Quest); implements drivers.base.protocols.Camera.

    The camera counts the framestamps, so a frame that is lost anywhere leaves a gap in them. An overrun of the ring
    buffer is an error. `describe` also returns the number of frames that were overwritten, and the number of losses
    that the transport reported. Two kinds of loss leave no gap and are visible only in the times: a trigger that comes
    too early; and the first frame of a run, if the camera does not restart its framestamps at each capture (the
    constructor tests this). One thread takes the frames. Another thread may call `disarm` or `close`, which end the
    wait of the first thread.

    Args:
        library: path of the DCAM-API library; None: the installed one. A process can have one session with it.
        index: number of the camera among those that DCAM finds, from 0.
        name: name of the camera in error messages.
        clock: gives the time of the first frame of a run. Later times come from the camera's own clock.
        options: response to triggers, correction of counts, and memory of the ring buffer.
        memory: memory for the frames that are taken.

    Raises:
        DeviceError: there is no library or no camera, or two test frames with counts and times did not arrive.
    """

    def __init__(
        self,
        library: Path | None,
        index: int = 0,
        name: str = "camera",
        *,
        clock: Clock | None = None,
        options: DcamOptions | None = None,
        memory: FrameMemory | None = None,
    ) -> None:
        self.name = name
        self._clock, self._options = clock or SystemClock(), options or DcamOptions()
        self._memory = memory or FrameMemory()
        self._inside = threading.Lock()  # held while a frame is taken, so that close() waits
        self._ring_lock = threading.Lock()  # held while slots are read or freed
        self._ring: Ring | None = None  # set while armed
        self._held: Ring | None = None  # True while allocated in the library, also if freeing failed
        self._clock_offset: float | None = None  # s, host time minus camera time in this run
        self._origin: int | None = None  # framestamp of the first trigger of this run; None until a frame shows it
        self._overwritten, self._transport_losses = 0, 0
        self._closed = False
        self._session = Session(library, index, name)
        try:
            self._dcam, self._camera = self._session.dcam, self._session.camera
            self._properties = Properties(self._dcam, self._camera, name)
            self._apply(_TEST_SETTINGS)  # because another program may have changed any setting
            stamps = self._first_framestamp(), self._first_framestamp()
            self._first_stamp = stamps[0] if stamps[0] == stamps[1] else None
        except BaseException:
            with suppress(DcamError):
                self._session.close()
            raise

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Apply settings and read them back. Only the exposure may differ, because the camera rounds it.

        Raises:
            DeviceRefused: the camera rejects a setting, or is armed. In the second case the earlier settings remain.
        """
        self._require_open()
        if self._ring is not None:
            raise DeviceRefused(self.name, "it is armed and cannot be configured", advice="disarm() it first")
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
        """Allocate the ring buffer and start the capture. When this returns, the camera accepts triggers.

        Raises:
            DeviceRefused: the camera is already armed, or n_frames < 1.
        """
        self._require_open()
        if self._ring is not None:
            raise DeviceRefused(self.name, "it is already armed", advice="disarm() it first")
        if n_frames < 1:
            raise DeviceRefused(self.name, f"the camera cannot be armed for less than one frame ({n_frames})")
        self.disarm()  # frees a ring buffer that could not be freed before
        if self._options.trigger_mode is TriggerMode.START:
            apply_trigger_source(self._properties, self._settings.trigger)
        # One more slot than frames, because the oldest slot of a full ring may be half overwritten at any moment.
        fitting = self._options.ring // round(self._properties.get(Property.BUFFER_FRAMEBYTES))
        slots = max(2, min(max(n_frames + 1, _LEAST_SLOTS), fitting))
        ring = self._start(slots, CaptureMode.SEQUENCE)
        self._overwritten, self._transport_losses, self._clock_offset = 0, 0, None
        self._origin = self._first_stamp
        self._ring = ring

    def software_trigger(self) -> None:
        if self._ring is None or self._settings.trigger is not TriggerSource.SOFTWARE:
            armed = "not armed" if self._ring is None else "armed"
            problem = f"the camera does not accept a software trigger now ({armed}, trigger {self._settings.trigger})"
            raise DeviceRefused(self.name, problem, advice="Set the trigger to software, and arm the camera")
        self._dcam.cap_firetrigger(self._camera)

    def next_frame(self, timeout: float) -> CameraFrame:
        """A copy of the oldest frame that was not returned yet.

        Raises:
            DeviceTimeout: no frame arrived within `timeout` s.
            DeviceRefused: the camera is not armed, or was disarmed during the wait.
            DeviceError: the ring buffer was overrun (later frames can still be taken), the camera is unplugged, or the
                capture ended by itself.
        """
        deadline = self._clock.now() + timeout
        while True:
            with self._inside:
                frame = self._look()
                if frame is not None:
                    return frame
                remaining = deadline - self._clock.now()
                if remaining <= 0:
                    problem = (
                        f"no frame arrived within {timeout:g} s of waiting for a trigger ({self._settings.trigger})"
                    )
                    advice = (
                        "Check that triggers arrive, and that they are not closer together than the camera's "
                        "shortest period"
                    )
                    raise DeviceTimeout(self.name, problem, advice=advice, state="It is still armed")
                self._await_event(min(remaining, _WAIT_SLICE))

    def disarm(self) -> None:
        """Stop the capture and free the ring buffer. This is allowed in every state, and ends the wait of another
        thread for a frame.

        Raises:
            DcamError: the library failed; a second call tries again.
        """
        if not self._closed:
            self._free()

    def wait_until_cold(self, timeout: float, progress: Progress = lambda celsius, status: None) -> float:
        """See `drivers.dcam.properties.wait_until_cold`."""
        self._require_open()
        return wait_until_cold(self._properties, self.name, self._clock, timeout, progress)

    def describe(self) -> dict[str, str | int | float]:
        """Identity and state of the camera, and the number of frames lost in the current or last run."""
        self._require_open()
        return {
            **description(self._session, self._properties, self._settings, self._options),
            "frames_overwritten": self._overwritten,
            "transport_losses": self._transport_losses,
            "framestamps_begin_anew": "no" if self._first_stamp is None else "yes",
        }

    def close(self) -> None:
        """Free all resources, even after a failure. A second call does nothing.

        Raises:
            DcamError: the first failure. An unplugged camera is not a failure.
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
        """Allocate a ring buffer and start a capture. The ring stays allocated until `_free`, also after an error."""
        ring = self._held = Ring(self._dcam, self._camera, self.name, slots, self._memory)
        try:
            ring.start(mode, self._clock)
        except BaseException:
            with suppress(DcamError):
                self._free()
            raise
        return ring

    def _first_framestamp(self) -> int:
        """Framestamp of the first frame of a capture (0 or 1, depending on the model).

        With this number, a lost first frame of a run is noticed.
        """
        ring = self._start(2, CaptureMode.SNAP)
        deadline = self._clock.now() + START_TIMEOUT
        while ring.arrived() < 2:
            if self._clock.now() > deadline:
                raise DeviceTimeout(
                    self.name,
                    f"only {ring.arrived()} of 2 test frames arrived within {START_TIMEOUT:g} s without triggers",
                    expected=f"2 frames of {_TEST_SETTINGS.exposure:g} s",
                    advice="Check the cable of the camera, then switch the camera off and on",
                    state="Nothing was measured",
                )
            self._await_event(_WAIT_SLICE)
        first, second = ring.stamps(0), ring.stamps(1)
        self._free()
        require_stamps(first, second, self.name)
        return int(first.framestamp)

    def _await_event(self, seconds: float) -> None:
        """Wait until the ring buffer may have changed; `_look` then reads the change."""
        try:
            self._dcam.wait_start(self._session.wait, self._session.events, max(1, round(seconds * 1000)))
        except DcamError as error:
            if error.code in (Error.LOSTFRAME, Error.MISSINGFRAME_TROUBLE):
                self._transport_losses += 1  # the capture continues, and the framestamps show which frame is missing
            elif error.code not in (Error.TIMEOUT, Error.ABORT):
                raise

    def _look(self) -> CameraFrame | None:
        """The next frame of the ring buffer; None if none has arrived."""
        self._require_open()
        with self._ring_lock:
            ring = self._ring
            if ring is None:
                raise DeviceRefused(
                    self.name, "the camera is not armed, so no frame will arrive", advice="arm() it first"
                )
            state = ring.state()  # read before the ring buffer, so that the last frame is not missed
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
                advice="Check the camera's power and cable, then arm the camera again",
                state="Frames taken before are good",
            )
        return None

    def _trigger_time(self, frame: BufFrame) -> float:
        """Time of the trigger, s since the Unix epoch.

        The camera's clock has its own epoch. The offset is the host's time at the first frame of the run, minus
        exposure and readout.
        """
        stamp = seconds_of(frame)
        if self._clock_offset is None:
            delay = self._settings.exposure + self._properties.get(Property.TIMING_READOUTTIME)
            self._clock_offset = self._clock.now() - delay - stamp
        external = self._settings.trigger is TriggerSource.EXTERNAL
        return self._clock_offset + stamp - (self._options.trigger_delay if external else 0.0)


def configured(section: Any, clock: Clock, memory: FrameMemory | None = None) -> DcamCamera:
    """Connect the camera that a section of a configuration describes; errors and `memory` as for `DcamCamera`."""
    library = None if section.library is None else Path(section.library)
    return DcamCamera(library, section.index, clock=clock, options=section.options, memory=memory)
