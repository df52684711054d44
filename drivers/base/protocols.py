"""Device Protocols: interfaces of stage, camera, shutter and devices that move in the beam. Units: rad, s and keV."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class StageLimits:
    """The limits of a stage.

    Attributes:
        counts_per_turn: encoder counts (or motor pulses) for 2π. Triggers are possible only at whole counts.
        max_speed, acceleration: rad/s, rad/s².
        low, high: soft limits in radians.
        trigger_output: True if the stage can emit position-synchronised trigger pulses.
        run_up: distance before the first pulse, in intervals of the train, within which the stage cannot be armed.
        pulse_spacing: smallest time in s between the pulses of a train at `max_speed`.
        interval_unit: counts; intervals of trains must be multiples of this number (2 if each trigger toggles the
            output).
        tolerance: largest distance from the target, in counts, at which a move counts as finished and a frame may be
            exposed.
    """

    counts_per_turn: int
    max_speed: float
    acceleration: float
    low: float
    high: float
    trigger_output: bool
    run_up: int = 0
    pulse_spacing: float = 0.0
    interval_unit: int = 1
    tolerance: int = 10


@dataclass(frozen=True)
class TriggerTrain:
    """Position-synchronised pulses at start, start + interval, ... (n of them), in whole counts.

    With a negative interval the stage turns in the negative direction.
    """

    start: int
    interval: int
    n: int

    @property
    def end(self) -> int:
        """Count of the last pulse."""
        return self.start + self.interval * (self.n - 1)


class DigitalOutput(Protocol):
    """One output line of some controller."""

    name: str

    def set(self, high: bool) -> None:
        """Set the line to high or low. Raises DeviceError if the controller refuses or fails."""

    def get(self) -> bool | None:
        """True if the line is high; None if the controller cannot read it back."""


class RotationStage(Protocol):
    """A rotation stage with position-synchronised trigger pulses. Callers use angles in radians; trains use whole
    counts."""

    name: str

    @property
    def limits(self) -> StageLimits: ...

    def to_counts(self, angle: float) -> int:
        """The nearest whole count to an angle in radians."""

    def to_angle(self, counts: int) -> float: ...

    def position(self) -> float:
        """Radians, read from the device."""

    def start_move(self, angle: float, speed: float) -> None:
        """Begin a move at `speed` (rad/s) and return at once. Raises DeviceRefused for a target outside the limits."""

    def start_home(self) -> None:
        """Begin the search for the reference mark and return at once. `wait` returns when the search has ended.

        Raises:
            DeviceRefused: the stage has no reference, or it is moving.
        """

    def moving(self) -> bool: ...

    def wait(self, timeout: float) -> float:
        """Wait for the end of the move; returns the position in rad.

        Raises DeviceTimeout, or DeviceError if it stopped early.
        """

    def stop(self) -> None:
        """Decelerate and stop. Allowed in every state."""

    def abort(self) -> None:
        """Stop at once, without deceleration. Allowed in every state."""

    def arm(self, train: TriggerTrain) -> None:
        """Prepare a train of pulses.

        The stage must be at rest, before the position of the first pulse. It sends the pulses when it moves.
        """

    def disarm(self) -> None: ...

    def digital_output(self, number: int) -> DigitalOutput:
        """Another output of the controller of the stage, for example one that opens a shutter.

        Raises:
            DeviceRefused: the controller has no such output, or the output is used for the trigger pulses.
        """

    def describe(self) -> dict[str, str | int | float]:
        """Identity and settings for the file's metadata."""

    def close(self) -> None: ...


class TriggerSource(StrEnum):
    INTERNAL = "internal"
    EXTERNAL = "external"
    SOFTWARE = "software"


@dataclass(frozen=True)
class CameraSettings:
    """The requested settings of a camera. The return value of `configure` has the settings that the camera accepted.

    Attributes:
        exposure: exposure time in s.
        trigger: what starts an exposure.
        roi: (row0, col0, rows, cols) of the sensor; None: the full sensor.
        binning: binning x binning pixels are summed.
        readout: name of a readout mode of the camera: "standard", "ultra_quiet" or "photon_number".
    """

    exposure: float
    trigger: TriggerSource
    roi: tuple[int, int, int, int] | None = None
    binning: int = 1
    readout: str = "standard"


@dataclass(frozen=True)
class CameraTiming:
    """The timing of the camera with its present settings. It is read from the camera and never computed by the caller.

    Attributes:
        shape: (rows, cols) of the next frames.
        min_period: smallest time in s between triggers; the camera ignores earlier pulses.
        readout: time in s to read a full frame.
        row_period: time in s by which each row starts later than the row above (rolling shutter); 0: global shutter.
        bits: bits of a count; saturation is at 2**bits - 1.
    """

    shape: tuple[int, int]
    min_period: float
    readout: float
    row_period: float
    bits: int


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """A frame from a camera: pixels, its own frame counter (from 0 at arm), and the time of the trigger in s."""

    counts: NDArray[np.uint16]
    framestamp: int
    time: float


class Camera(Protocol):
    """A triggered area camera with a ring of buffers."""

    name: str

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Apply the settings and read them back. Raises DeviceRefused if the camera does not accept them."""

    @property
    def timing(self) -> CameraTiming: ...

    def arm(self, n_frames: int) -> None:
        """Allocate the ring buffer and wait for triggers; framestamps start at 0."""

    def software_trigger(self) -> None:
        """Expose one frame (trigger source SOFTWARE)."""

    def next_frame(self, timeout: float) -> CameraFrame:
        """The oldest frame that was not returned yet. Raises DeviceTimeout if no frame arrives within `timeout` s."""

    def disarm(self) -> None:
        """Stop the camera and free the ring buffer. This is allowed in every state."""

    def describe(self) -> dict[str, str | int | float]: ...

    def close(self) -> None: ...


class CooledCamera(Camera, Protocol):
    def wait_until_cold(self, timeout: float, progress: Callable[[float, str], None]) -> float:
        """Wait until the sensor is cold, but at most `timeout` s. Returns the temperature of the sensor in °C.

        `progress` is called with the temperature and the status of the cooler. Raises DeviceError if the sensor does
        not get cold, or if the cooler is off or reports a fault."""


class Shutter(Protocol):
    """Beam shutter. It must be closed for darks. `by_hand`: True if the operator is asked to move it."""

    name: str
    by_hand: bool

    def open(self) -> None: ...

    def close(self) -> None: ...

    def is_open(self) -> bool: ...


@runtime_checkable
class ConnectedShutter(Shutter, Protocol):
    """A shutter with its own connection."""

    def disconnect(self) -> None:
        """Close the connection; the shutter does not move."""


class SampleMover(Protocol):
    """Moves the sample out of the beam for flats, and back."""

    name: str

    def out(self) -> None: ...

    def back(self, aside: float = 0.0) -> None:
        """Move the sample into the beam, `aside` mm from its position, towards higher columns of the frame."""


class Filter(Protocol):
    """A filter (attenuator) in the beam with several named places; one of them may be empty."""

    name: str

    def put(self, place: str) -> None:
        """Move the filter to a place, and return when it has arrived. Raises DeviceError if it did not arrive."""

    def place(self) -> str | None:
        """Name of the present place; None if it has no name or is not known. Raises DeviceError."""


class ConnectedFilter(Filter, Protocol):
    """A filter with its own connection."""

    def close(self) -> None:
        """Close the connection; the filter stays where it is."""


class Monochromator(Protocol):
    """Sets the photon energy of the beam, in keV."""

    name: str

    def move_to(self, energy: float) -> None:
        """Move to an energy, and return when the monochromator has settled. Raises DeviceError if it did not arrive."""

    def energy(self) -> float | None:
        """Present energy in keV; None if it is not known. Raises DeviceError."""


class ConnectedMonochromator(Monochromator, Protocol):
    """A monochromator with its own connection."""

    def energy(self) -> float: ...

    def stop(self) -> None:
        """Stop the monochromator if it can be stopped. Raises DeviceError."""

    def close(self) -> None:
        """Close the connection; the monochromator does not move."""


@runtime_checkable
class Watchable(Protocol):
    """A device that moves while its caller waits, such as a sample mover, a filter or a monochromator on a motor."""

    def watch(self, check: Callable[[], None]) -> None:
        """From now on, the device calls `check` repeatedly while it moves. An exception from `check` ends the wait."""


@runtime_checkable
class Rechecked(Protocol):
    """A device whose position counts as known after a move, and can be checked again later."""

    def remember_place(self) -> Callable[[], str]:
        """Store the present position. Returns a function that returns a sentence with the new position if the device
        has moved, or "" if it has not.

        Both raise DeviceError."""


@dataclass(frozen=True)
class BeamReading:
    """A beam monitor's reading: a value in `unit` (ion chamber: A, ring current: mA), at a time in s since 1970."""

    value: float
    unit: str
    time: float


class BeamMonitor(Protocol):
    """A device that reads the beam intensity."""

    name: str

    def reading(self) -> BeamReading:
        """Present value, always finite. Raises DeviceTimeout, or DeviceError if the answer is not a number."""

    def close(self) -> None: ...


@dataclass(frozen=True)
class Devices:
    """The devices of the instrument."""

    stage: RotationStage
    camera: Camera
    shutter: Shutter
    sample: SampleMover
    filter: Filter | None = None
    monochromator: Monochromator | None = None
