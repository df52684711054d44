"""The registry of cameras of other packages; `drivers.dcam` and the simulated ORCA-Quest have their own sections."""

from __future__ import annotations

from typing import Any, Protocol

from drivers.base.clock import Clock
from drivers.base.protocols import Camera, CameraSettings, CameraTiming
from drivers.stages.settings import with_keys
from recon.base.registry import Registry


class CameraDriver(Protocol):
    """A driver's class, which the entry point of a package names.

    Attributes:
        Settings: a frozen dataclass of its settings; fields say with `drivers.stages.settings.key` how a configuration
        writes them.
    """

    Settings: type[Any]

    def __call__(self, settings: Any, clock: Clock) -> Camera:
        """The driver, connected. Raises DeviceError if there is no such camera."""

    def timing_of(self, settings: Any, wanted: CameraSettings) -> CameraTiming:
        """The camera's timing, before it is connected. Raises ValueError for settings that it would refuse."""


CAMERAS: Registry[CameraDriver] = Registry("camera", {}, with_keys, reserved=("dcam", "simulated_orca"))
"""Kind in a configuration -> the driver."""
