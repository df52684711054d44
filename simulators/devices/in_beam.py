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

POLL = 0.05  # s between looks at who may end the wait


class SimulatedMonochromator:
    """Implements `drivers.base.protocols.Monochromator` and `Watchable`.

    Args:
        energy: keV of the scene as it is; None: it states none.
        scene_at: the scene at an energy in keV; an error of it leaves the monochromator where it stands.
        show: takes the sample and the beam of all later frames.
        settle: s that each move takes.
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
        while (left := deadline - self._clock.now()) > 0:
            self._check()
            self._clock.sleep(min(POLL, left))
        self._show(scene)
        self._energy = energy

    def energy(self) -> float | None:
        return self._energy


class SimulatedShutter:
    """Implements `drivers.base.protocols.Shutter`; it starts closed, as a beamline does."""

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
    """Implements `drivers.base.protocols.SampleMover`; it starts with the sample in the beam."""

    def __init__(self, name: str = "sample mover") -> None:
        self.name = name
        self._aside: float | None = 0.0

    def out(self) -> None:
        self._aside = None

    def back(self, aside: float = 0.0) -> None:
        self._aside = aside

    def place(self) -> float | None:
        """mm by which the sample stands aside, None: out of the beam; the simulated camera asks it."""
        return self._aside


@dataclass(frozen=True)
class Exposed:
    """A frame that was exposed, but is not computed yet.

    Attributes:
        framestamp: counts from 0 with every arm.
        number: over the camera's life.
        time: of the trigger, s since the Unix epoch.
        angle: of the stage then, radians.
        ready: when the frame can be taken, s since the Unix epoch.
        beam: whether the shutter was open.
        sample: mm by which the sample stood aside; None: out of the beam.
        view: projections exposed before this one.
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
        scene: what stands in the beam.
        settings: the camera's.
        pitch: mm at the sample of an unbinned sensor pixel.
        seed: of all random numbers.
        angle_at: of the stage, radians at s since the Unix epoch.
        connected: s since the Unix epoch; the age of drifts counts from here.
        model: of the camera.
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
        middle = (binning - 1) / 2  # middle of a binned pixel, in sensor pixels from the middle of its first
        return Detector(
            shape=orca_quest.timing(self.settings, model=self.model).shape,
            pitch=self.pitch * binning,
            axis_col=(axis_col - col0 - middle) / binning,
            axis_row=(axis_row - row0 - middle) / binning,
            sod=self.scene.beam.source_distance,
        )

    def shot(self, frame: Exposed) -> Shot:
        """The shot. Without effects of motion its angle is that of mid-exposure, as a reconstruction assumes."""
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
