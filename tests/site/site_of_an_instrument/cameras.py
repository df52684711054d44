"""A camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout
from drivers.base.protocols import CameraFrame, CameraSettings, CameraTiming, TriggerSource
from recon.base.setting import setting


@dataclass(frozen=True)
class SiteCameraSettings:
    readout: float = setting(2e-3, "Of a frame.", unit="s", gt=0)
    offset: int = setting(100, "Counts without light.", ge=0)


class SiteCamera:
    """A camera with a global shutter that takes what it is given at `pulses` (s)."""

    name, Settings, RING = "camera", SiteCameraSettings, 64

    def __init__(self, settings: SiteCameraSettings, clock: Clock) -> None:
        self._own, self._clock, self.pulses = settings, clock, list[float]()
        self._asked = CameraSettings(0.01, TriggerSource.INTERNAL)
        self._armed_for, self._closed = 0, False
        self._armed_at, self._times, self._taken = 0.0, list[float](), 0

    @staticmethod
    def timing_of(settings: SiteCameraSettings, wanted: CameraSettings) -> CameraTiming:
        if not 1e-5 <= wanted.exposure <= 10:
            raise ValueError(f"an exposure of {wanted.exposure:g} s is not possible; expected 1e-5 to 10 s")
        if wanted.binning != 1:
            raise ValueError("it does not bin")
        shape = (1000, 1000) if wanted.roi is None else wanted.roi[2:]
        return CameraTiming(shape, wanted.exposure + settings.readout, settings.readout, 0.0, 16)

    @property
    def timing(self) -> CameraTiming:
        return self.timing_of(self._own, self._asked)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        self._refuse_closed()
        if self._armed_for:
            raise DeviceRefused(self.name, "it is armed; disarm it first")
        try:
            self.timing_of(self._own, settings)
        except ValueError as error:
            raise DeviceRefused(self.name, str(error)) from error
        self._asked = settings
        return settings

    def arm(self, n_frames: int) -> None:
        self._refuse_closed()
        if self._armed_for or n_frames < 1:
            raise DeviceRefused(self.name, "armed already, or for less than one frame: disarm it, n >= 1")
        self._armed_for, self._armed_at, self._times, self._taken = n_frames, self._clock.now(), [], 0

    def software_trigger(self) -> None:
        if not self._armed_for:
            raise DeviceRefused(self.name, "it is not armed")
        if self._asked.trigger is not TriggerSource.SOFTWARE:
            raise DeviceRefused(self.name, f"it waits for {self._asked.trigger} triggers")
        self._times.append(self._clock.now())

    def next_frame(self, timeout: float) -> CameraFrame:
        deadline = self._clock.now() + timeout
        while True:
            if not self._armed_for:
                raise DeviceRefused(self.name, "it is not armed")
            now = self._clock.now()
            self._look(now)
            ready = sum(time + self.timing.min_period <= now for time in self._times)
            if (lost := ready - self._taken - self.RING) > 0:
                self._taken += lost
                raise DeviceError(self.name, f"the ring of {self.RING} frames was overrun and {lost} frames are lost")
            if ready > self._taken:
                stamp, self._taken = self._taken, self._taken + 1
                counts = np.full(self.timing.shape, self._own.offset + stamp, np.uint16)
                return CameraFrame(counts, stamp, self._times[stamp])
            if now >= deadline:
                raise DeviceTimeout(self.name, f"no frame came within {timeout:g} s")
            self._clock.sleep(min(1e-3, deadline - now))

    def disarm(self) -> None:
        self._armed_for = 0

    def describe(self) -> dict[str, str | int | float]:
        return {"model": "site camera", "conversion_factor": 0.5, "conversion_offset": self._own.offset}

    def close(self) -> None:
        self._armed_for, self._closed = 0, True

    def _look(self, now: float) -> None:
        """Accept the triggers by now."""
        period = self.timing.min_period * (1 - 1e-6)
        if self._asked.trigger is TriggerSource.INTERNAL:
            self._times = [self._armed_at + k * self.timing.min_period for k in range(self._armed_for)]
        elif self._asked.trigger is TriggerSource.EXTERNAL:
            last = self._times[-1] + period if self._times else self._armed_at
            for time in sorted(time for time in self.pulses if last <= time <= now):
                if not self._times or time - self._times[-1] >= period:
                    self._times.append(time)

    def _refuse_closed(self) -> None:
        if self._closed:
            raise DeviceError(self.name, "it is closed")
