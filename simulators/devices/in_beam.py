"""Simulated devices in the beam, whose effect the simulated camera shows: shutter, sample mover and monochromator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drivers import orca_quest
from drivers.base.clock import Clock
from drivers.base.protocols import CameraSettings
from simulators.frame.sensor import CONVERSION
from simulators.frame.shot import AngleAt, Detector, Shot
from simulators.scenes.scene import Scene

POLL = 0.05  # s between two calls of the function that may end the wait


class SimulatedMonochromator:
    """Implements `drivers.base.protocols.Monochromator` and `Watchable`.

    Args:
        energy: energy of the scene in keV; None: the scene has no energy.
        scene_at: function that returns the scene at an energy in keV; if it raises an error, the monochromator does not
            move.
        show: function that sets the sample and the beam of all later frames.
        settle: duration of each move in s.
    """

    def __init__(
        self,
        energy: float | None,
        scene_at: Callable[[float], Scene],
        show: Callable[[Scene], None],
        clock: Clock,
        settle: float = 0.0,
        name: str = "monochromator",
    ) -> None:
        self.name = name
        self._energy, self._scene_at, self._show = energy, scene_at, show
        self._clock, self._settle = clock, settle
        self._check: Callable[[], None] = lambda: None

    def watch(self, check: Callable[[], None]) -> None:
        self._check = check

    def move_to(self, energy: float) -> None:
        if energy == self._energy:
            return
        scene = self._scene_at(energy)
        deadline = self._clock.now() + self._settle
        while (remaining := deadline - self._clock.now()) > 0:
            self._check()
            self._clock.sleep(min(POLL, remaining))
        self._show(scene)
        self._energy = energy

    def energy(self) -> float | None:
        return self._energy


class SimulatedShutter:
    """Implements `drivers.base.protocols.Shutter`; it is closed at the start."""

    by_hand = False

    def __init__(self, name: str = "shutter") -> None:
        self.name = name
        self._open = False

    def open(self) -> None:
        self._open = True

    def close(self) -> None:
        self._open = False

    def is_open(self) -> bool:
        return self._open


class SimulatedSampleMover:
    """Implements `drivers.base.protocols.SampleMover`; at the start the sample is in the beam."""

    def __init__(self, name: str = "sample mover") -> None:
        self.name = name
        self._aside: float | None = 0.0

    def out(self) -> None:
        self._aside = None

    def back(self, aside: float = 0.0) -> None:
        self._aside = aside

    def place(self) -> float | None:
        """mm by which the sample is moved sideways; None: out of the beam. The simulated camera reads it."""
        return self._aside


@dataclass(frozen=True)
class Exposed:
    """A frame that was exposed, but is not computed yet.

    Attributes:
        framestamp: number from 0 since the camera was armed.
        number: number of the frame over the life of the camera.
        time: time of the trigger, s since the Unix epoch.
        angle: angle of the stage at this time, radians.
        ready: time from which the frame can be read, s since the Unix epoch.
        beam: True if the shutter was open.
        sample: mm by which the sample was moved sideways; None: out of the beam.
        view: number of projections exposed before this frame.
    """

    framestamp: int
    number: int
    time: float
    angle: float
    ready: float
    beam: bool
    sample: float | None
    view: int


@dataclass(frozen=True, eq=False)
class CameraView:
    """A scene in front of a camera.

    Attributes:
        scene: the scene.
        settings: settings of the camera.
        pitch: size of an unbinned sensor pixel at the sample in mm.
        seed: seed of all random numbers.
        angle_at: function that returns the angle of the stage in radians at a time in s since the Unix epoch.
        connected: s since the Unix epoch; drifts begin at this time.
        model: model of the camera.
    """

    scene: Scene
    settings: CameraSettings
    pitch: float
    seed: int
    angle_at: AngleAt
    connected: float
    model: str = orca_quest.MODEL

    @property
    def roi(self) -> tuple[int, int, int, int]:
        """(row0, col0, rows, cols) of the sensor."""
        return self.settings.roi or (0, 0, *orca_quest.SENSOR_SHAPE)

    @property
    def detector(self) -> Detector:
        row0, col0, *_ = self.roi
        binning = self.settings.binning
        axis_row, axis_col = ((n - 1) / 2 for n in orca_quest.SENSOR_SHAPE)
        axis_col += self.scene.axis_offset_px
        # middle of a binned pixel, in sensor pixels from the middle of its first sensor pixel
        middle = (binning - 1) / 2
        return Detector(
            shape=orca_quest.timing(self.settings, model=self.model).shape,
            pitch=self.pitch * binning,
            axis_col=(axis_col - col0 - middle) / binning,
            axis_row=(axis_row - row0 - middle) / binning,
            sod=self.scene.beam.source_distance,
        )

    def shot(self, frame: Exposed) -> Shot:
        """The conditions of a frame.

        Without effects of motion, the angle is that of mid-exposure, as a reconstruction assumes.
        """
        middle = frame.time + self.settings.exposure / 2
        turned = 0.0 if self.scene.chain.moves else self.angle_at(middle) - self.angle_at(frame.time)
        return Shot(
            detector=self.detector,
            exposure=self.settings.exposure,
            time=frame.time,
            angle=frame.angle + turned,
            angle_at=self.angle_at,
            elapsed=frame.time - self.connected,
            row_period=orca_quest.timing(self.settings, model=self.model).row_period,
            model=self.model,
            roi=self.roi,
            binning=self.settings.binning,
            readout=self.settings.readout,
            conversion=CONVERSION[self.settings.readout],
            beam=frame.beam,
            sample=frame.sample is not None,
            radius=self.scene.sample.radius,
            seed=self.seed,
            frame=frame.number,
            view=frame.view,
            aside=frame.sample or 0.0,
        )
