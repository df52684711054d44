"""AreaDetectorCamera: a camera of an EPICS areaDetector. Records control the camera, and frames come over PVAccess.

The time of a frame is the time at which the driver received it, minus exposure and readout. This time differs from the
time of the pulse by milliseconds.
"""

from __future__ import annotations

import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import CameraFrame, CameraSettings, CameraTiming, TriggerSource
from recon.base.setting import setting
from splatline_areadetector.arrays import ArrayFrame, FrameRefusedError
from splatline_areadetector.camera_records import DRIVERS, LOOK_EVERY, DriverLabels, Records
from splatline_areadetector.stream import Died, Disconnected, FrameStream, Item, Overflow, Queues, Refused

_SETTLED = 0.2  # s without a frame, after which a stopped camera counts as silent
_LONGEST = 3600.0  # longest exposure in s
_LEAST_RING = 2  # smallest number of frames in the ring


@dataclass(frozen=True)
class AreaDetectorSettings:
    """Settings of the IOC and its camera, including values that EPICS does not report."""

    prefix: str = setting(..., "Prefix of the IOC's records, with ca:// or pva://, such as ca://2bmSP2:.")
    driver: Literal["spinnaker", "simdetector", "pco", "andor3", "hamamatsu", "eiger"] = setting(
        ..., "Driver of areaDetector, which determines the labels of the trigger records."
    )
    sensor: tuple[int, int] = setting(..., "Rows and columns of the sensor.")
    readout: float = setting(..., "Read-out time of a full frame.", unit="s", gt=0, le=100)
    electrons_per_count: float = setting(..., "Electrons per count, from the data sheet.", gt=0, le=1e6)
    image: str | None = setting(
        None, "Address of the image that carries the frames, pva://NAME; null: PREFIXPva1:Image."
    )
    line: str = setting("Line0", "The camera's input for trigger pulses (spinnaker).")
    min_period: float = setting(0.0, "Shortest time between two triggers.", unit="s", ge=0, le=100)
    dead: float = setting(
        0.0,
        "Shortest time from the end of an exposure to the start of the next one. If the camera cannot expose during "
        "readout, give the value of readout_s.",
        unit="s",
        ge=0,
        le=100,
    )
    row_period: float = setting(
        0.0, "Time from one row to the next of a rolling shutter; 0: global shutter.", unit="s", ge=0, le=1
    )
    bits: int = setting(16, "Bits of a pixel.", ge=8, le=16)
    offset: float = setting(0.0, "Counts without beam.", ge=0, le=65535)
    ring: int = setting(2_000, "Memory for frames that wait for the disk.", unit="mb", ge=1, le=1_000_000)
    timeout: float = setting(
        5.0, "Longest time in s that the driver waits for an answer of the IOC.", unit="s", gt=0, le=100
    )


class AreaDetectorCamera:
    """Implements drivers.base.protocols.Camera. See `AreaDetectorSettings`.

    Framestamps are the frame numbers of the driver, from 0 at arm, so that a lost frame leaves a gap. If the camera
    counts them (spinnaker, hamamatsu), a loss of the very first frame is noticed only at the end, because a frame is
    missing there. One thread takes frames; another may call `disarm` or `close`, which end the wait for a frame.

    Raises:
        DeviceTimeout, DeviceError: the IOC does not answer, or its image cannot be stored.
        DeviceRefused: the sensor is not the configured one, or a plugin shows only part of the image.
    """

    Settings = AreaDetectorSettings

    def __init__(self, settings: AreaDetectorSettings, clock: Clock) -> None:
        self.name, self._own, self._clock = "camera", settings, clock
        self._labels: DriverLabels = DRIVERS[settings.driver]
        self._records = Records(settings.prefix, self.name, settings.timeout, clock)
        self._changed = threading.Condition()
        self._ring = deque[CameraFrame]()
        self._ring_size, self._lost, self._overrun = _LEAST_RING, 0, 0
        self._problem: DeviceError | None = None
        self._origin: int | None = None
        self._armed, self._closed = False, False
        try:
            self._refuse_other_sensor()
            self._settings = CameraSettings(float(self._records.read("cam1:AcquireTime_RBV")), TriggerSource.INTERNAL)
            image = settings.image or f"pva://{settings.prefix.partition('://')[2]}Pva1:Image"
            self._stream = FrameStream(image, Queues(ring_megabytes=1e-6 * settings.ring), within=settings.timeout)
        except FrameRefusedError as error:
            self._records.close()
            raise DeviceError(self.name, f"its image cannot be stored: {error}", state="Nothing was set") from error
        except BaseException:
            self._records.close()
            raise
        self._collector = threading.Thread(target=self._collect, name="frames of areaDetector", daemon=True)
        self._collector.start()

    @staticmethod
    def timing_of(settings: AreaDetectorSettings, wanted: CameraSettings) -> CameraTiming:
        """The timing from the configuration. Raises ValueError for settings that are not possible."""
        rows, cols = settings.sensor
        if not 0 < wanted.exposure <= _LONGEST:
            raise ValueError(f"an exposure of {wanted.exposure:g} s is not possible; expected up to {_LONGEST:g} s")
        if wanted.readout != "standard":
            raise ValueError(f"readout {wanted.readout!r} is unknown; legal: standard")
        row0, col0, height, width = wanted.roi or (0, 0, rows, cols)
        if row0 + height > rows or col0 + width > cols:
            raise ValueError(f"roi {list(wanted.roi or ())} extends beyond the sensor of {rows} x {cols} pixels")
        if height % wanted.binning or width % wanted.binning:
            raise ValueError(f"{height} x {width} pixels cannot be divided by binning {wanted.binning}")
        shape = height // wanted.binning, width // wanted.binning
        period = max(settings.min_period, wanted.exposure + settings.dead)
        return CameraTiming(shape, period, settings.readout, settings.row_period, settings.bits)

    @property
    def timing(self) -> CameraTiming:
        self._require_open()
        return self.timing_of(self._own, self._settings)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set the records and read them back. The camera may round the exposure.

        Raises:
            DeviceRefused: the settings are not possible, or the camera is armed; the earlier settings stay.
        """
        self._require_open()
        if self._armed:
            raise DeviceRefused(
                self.name, "the camera cannot be configured while it is armed", advice="disarm() it first"
            )
        try:
            self.timing_of(self._own, settings)
        except ValueError as error:
            raise DeviceRefused(self.name, str(error), state="Its settings were not changed") from error
        try:
            self._settings = self._applied(settings)
        except DeviceError:
            with suppress(DeviceError):
                self._applied(self._settings)
            raise
        return self._settings

    def arm(self, n_frames: int) -> None:
        """Wait for triggers; framestamps start at 0.

        Raises:
            DeviceRefused: the camera is armed already, or n_frames < 1.
        """
        self._require_open()
        if self._armed:
            raise DeviceRefused(self.name, "it is armed already", advice="disarm() it first")
        if n_frames < 1:
            raise DeviceRefused(self.name, f"the camera cannot be armed for less than one frame ({n_frames})")
        labels, trigger = self._labels, self._settings.trigger
        self._await_silence()
        by_pulse = trigger is TriggerSource.EXTERNAL
        if labels.train:
            self._records.set(f"cam1:{labels.train}", n_frames if by_pulse else 1)
        in_one = trigger is TriggerSource.INTERNAL or (by_pulse and not labels.train)
        self._records.set("cam1:NumImages", n_frames if in_one else 1)
        if labels.counted:
            self._records.set("cam1:ArrayCounter", 0)
        rows, cols = self.timing.shape
        with self._changed:
            self._ring.clear()
            # Half of the memory is kept for arriving frames and for frames that are being written, so that the newest
            # frame has space.
            self._ring_size = max(_LEAST_RING, self._own.ring // 2 // (2 * rows * cols))
            self._lost = self._overrun = 0
            self._problem, self._origin = None, 1 if labels.counted else None
            self._armed = True
        try:
            if labels.fire or trigger is not TriggerSource.SOFTWARE:
                self._records.set("cam1:Acquire", 1)
        except BaseException:
            self._armed = False
            raise

    def software_trigger(self) -> None:
        """Expose one frame. Raises DeviceRefused: not armed, or configured for another trigger."""
        if not self._armed or self._settings.trigger is not TriggerSource.SOFTWARE:
            armed = "armed" if self._armed else "not armed"
            problem = (
                f"the camera cannot take a software trigger now: it is {armed}, and its trigger is set to "
                f"{self._settings.trigger}"
            )
            raise DeviceRefused(self.name, problem, advice="Set the trigger to software, and arm the camera")
        if self._labels.fire:
            self._records.write(f"cam1:{self._labels.fire}", 1)
        else:
            self._records.await_value("cam1:Acquire", 0)  # the acquisition of the previous frame
            self._records.write("cam1:Acquire", 1)

    def next_frame(self, timeout: float) -> CameraFrame:
        """The oldest frame not yet taken.

        Raises:
            DeviceTimeout: no frame came within `timeout` s.
            DeviceRefused: not armed, or disarmed while waiting.
            DeviceError: the ring buffer overflowed (later frames can still be taken), frames have another size or type
                than was set, or the connection to the IOC was lost.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._ring or self._lost or self._problem or not self._armed, timeout)
            if not self._armed:
                raise DeviceRefused(
                    self.name, "the camera is not armed, so no frame will come", advice="arm() it first"
                )
            lost, self._lost = self._lost, 0
            if lost:
                raise DeviceError(
                    self.name,
                    f"the ring buffer of {self._ring_size} frames was overrun and {lost} frames are lost",
                    advice=(
                        "Fetch frames faster, trigger more slowly, or raise ring_mb (memory for frames that wait "
                        "for the disk)"
                    ),
                    state="Later frames can be taken",
                )  # fmt: skip
            if self._ring:
                return self._ring.popleft()
            problem, self._problem = self._problem, None
            if problem is not None:
                raise problem
        raise DeviceTimeout(
            self.name, f"no frame came within {timeout:g} s (trigger: {self._settings.trigger})",
            advice="Check that triggers arrive, that cam1:ArrayCallbacks and Pva1:EnableCallbacks are Enable, and that "
            "Pva1:MinCallbackTime is 0", state="It is still armed",
        )  # fmt: skip

    def disarm(self) -> None:
        """Stop the camera and drop frames that were not taken; allowed in every state."""
        if self._closed:
            return
        with self._changed:
            was_armed, self._armed = self._armed, False
            self._ring.clear()
            self._changed.notify_all()
        if was_armed:
            self._records.set("cam1:Acquire", 0)

    def describe(self) -> dict[str, str | int | float]:
        """Identity and settings, and the number of frames lost in our ring buffer in the current or last run."""
        self._require_open()
        return {
            "model": str(self._records.read("cam1:Model_RBV")) or "areaDetector",
            "maker": str(self._records.read("cam1:Manufacturer_RBV")),
            "driver": self._own.driver,
            "exposure": self._settings.exposure,
            "trigger": str(self._settings.trigger),
            "binning": self._settings.binning,
            "conversion_factor": self._own.electrons_per_count,
            "conversion_offset": self._own.offset,
            "min_period": self.timing.min_period,
            "row_period": self._own.row_period,
            "frames_overwritten": self._overrun,
            "framestamps_begin_anew": "yes" if self._labels.counted else "no",
        }

    def close(self) -> None:
        """Stop the camera and close all connections. A second call does nothing."""
        if self._closed:
            return
        try:
            self.disarm()
        finally:
            self._closed = True
            self._stream.close()
            self._collector.join()
            self._records.close()

    def _require_open(self) -> None:
        if self._closed:
            raise DeviceError(self.name, "it is closed", advice="Connect again")

    def _refuse_other_sensor(self) -> None:
        rows, cols = (int(self._records.read(f"cam1:MaxSize{axis}_RBV")) for axis in "YX")
        if (rows, cols) != tuple(self._own.sensor):
            raise DeviceRefused(
                self.name,
                f"the sensor of the camera has {rows} x {cols} pixels, but devices.camera.sensor states "
                f"{list(self._own.sensor)}",
                advice="Correct `sensor`; if `prefix` names another camera than you want, correct `prefix`",
                state="Nothing was set",
            )  # fmt: skip

    def _applied(self, wanted: CameraSettings) -> CameraSettings:
        """Write the settings. Returns them with the exposure that the camera accepted."""
        records, labels = self._records, self._labels
        records.set("cam1:Acquire", 0)
        row0, col0, height, width = wanted.roi or (0, 0, *self._own.sensor)
        n = wanted.binning
        across = n if labels.binned_region else 1
        for record in ("MinX", "MinY"):  # moved to the corner first, because otherwise a larger region would not fit
            records.write(f"cam1:{record}", 0)
        binnings = {"A3Binning": labels.binning.format(n)} if labels.binning else {"BinX": n, "BinY": n}
        region = {"SizeX": width // across, "SizeY": height // across, "MinX": col0 // across, "MinY": row0 // across}
        for record, value in {**binnings, **region, **labels.triggers[wanted.trigger]}.items():
            records.set(f"cam1:{record}", value.format(line=self._own.line) if isinstance(value, str) else value)
        if labels.modes is not None:
            records.set("cam1:ImageMode", labels.modes[wanted.trigger])
        exposure = float(records.set("cam1:AcquireTime", wanted.exposure))
        accepted = replace(wanted, exposure=exposure)
        if wanted.trigger is TriggerSource.INTERNAL:
            records.write("cam1:AcquirePeriod", self.timing_of(self._own, accepted).min_period)
        return accepted

    def _await_silence(self) -> None:
        """Drop frames of an earlier run that may still arrive from the network."""
        silent, items_before = self._clock.now(), self._stream_items
        while self._clock.now() - silent < _SETTLED:
            self._clock.sleep(LOOK_EVERY)
            if self._stream_items != items_before:
                silent, items_before = self._clock.now(), self._stream_items

    _stream_items = 0

    def _collect(self) -> None:
        """Move frames from the stream into the ring, in a thread, until the stream is closed."""
        while not self._closed:
            if (item := self._stream.next(_SETTLED)) is None:
                continue
            self._stream_items += 1
            with self._changed:
                if self._armed:
                    self._take(item)
                    self._changed.notify_all()

    def _take(self, item: Item) -> None:
        match item:
            case Overflow():
                self._lost += 1
                self._overrun += 1
            case Refused(_, why):
                self._fail(f"its frames cannot be stored: {why}")
            case Died(code):
                self._fail(
                    f"the process that receives the camera's frames has ended (exit code {code}); a new process is "
                    "being started",
                    state="Frames taken before are good",
                )
            case Disconnected():
                advice = "Check whether the camera's IOC runs; the camera continues when the IOC is back"
                self._fail("the connection to its IOC was lost", advice, "Frames taken before are good")
            case ArrayFrame(is_current=False):
                self._take_frame(item)

    def _fail(
        self, problem: str, advice: str = "", state: str = "The camera is still armed, and frames taken before are good"
    ) -> None:
        self._problem = DeviceError(self.name, problem, advice=advice, state=state)

    def _take_frame(self, item: ArrayFrame) -> None:
        shape = self.timing_of(self._own, self._settings).shape
        if item.window.shape != shape:
            self._fail(
                f"the frames have {item.window.shape[0]} x {item.window.shape[1]} pixels, but {shape[0]} x {shape[1]} "
                "were set", "Check Pva1:NDArrayPort: the port may be that of a plugin that bins or crops frames",
            )  # fmt: skip
            return
        if self._origin is None:
            self._origin = item.unique_id
        exposed_from = item.time - self._settings.exposure - self._own.readout
        try:
            frame = CameraFrame(item.counts(), item.unique_id - self._origin, exposed_from)
        except ValueError as error:
            self._fail(f"a frame is damaged: {error}")
            return
        if len(self._ring) >= self._ring_size:
            self._ring.popleft()
            self._lost += 1
            self._overrun += 1
        self._ring.append(frame)
