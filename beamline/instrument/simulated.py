"""Simulated instrument: simulated devices, behind the real drivers where these exist.

This module is imported only if it is needed, so that a real instrument loads no simulator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any
from uuid import uuid4

from beamline.config.beam import (
    BeamMonitorSection,
    MotorFilter,
    NoFilter,
    SceneMonochromator,
    StageMover,
    StageOutputShutter,
)
from beamline.config.devices import SimulatedOrca
from beamline.config.load import Config, config_folder, scene_mapping
from beamline.config.models import SimulationSection, Speed
from beamline.config.stages import StageSection
from beamline.core.errors import ConfigError
from beamline.simulate import volumes_beside
from drivers import orca_quest
from drivers.base.clock import Clock, SystemClock
from drivers.base.protocols import Devices, Filter, Monochromator, SampleMover, Shutter
from drivers.in_beam import ManualFilter, OutputShutter
from recon.base.registry import Registry, in_folders
from recon.base.volume import Grid, Volume
from simulators.devices.camera import OrcaQuestBuild, SimulatedOrcaQuest
from simulators.devices.clock import VIRTUAL_START, ScaledClock, VirtualClock
from simulators.devices.in_beam import (
    SimulatedMonochromator,
    SimulatedSampleMover,
    SimulatedShutter,
)
from simulators.devices.trigger_line import TriggerLine
from simulators.effects.chain import AnomalyLabel
from simulators.frame.mapping import SceneError
from simulators.frame.shot import CannotExposeError
from simulators.scenes.scene import Scene, load_scene
from simulators.wires.wire import Build, Controller, register


def _fitting(name: str, build: type[Build]) -> type[Build]:
    """Return the class if it can build a simulated controller. Otherwise raise AttributeError."""
    _ = build.matching
    return build


WIRES: Registry[type[Build]] = Registry(
    "wire",
    {
        kind: getattr(import_module(f"simulators.wires.{kind}.wire"), name)
        for kind, name in in_folders("simulators.wires", "CONTROLLERS").items()
    },
    _fitting,
)
"""For each kind, the class that builds its simulated controller."""


# deg or mm: largest distance of a motor from its position at which the sample still counts as being there
IN_PLACE = 0.1


@dataclass(frozen=True)
class SimulatedScene:
    """The true values of a simulated scene, which a real instrument cannot know."""

    # truth: the sample's attenuation on a grid whose z is measured, as reconstructions do it, from the middle of the
    # camera's rows
    truth: Callable[[Grid], Volume]
    # cone: mm from the source to the rotation axis and to the detector; None for a parallel beam
    cone: tuple[float, float] | None
    # labels: function that returns the anomalies of an earlier frame, given the time of its exposure (s since the Unix
    # epoch)
    labels: Callable[[float], Sequence[AnomalyLabel]]
    # rehearse: function that makes a frame with the present settings of the camera; ConfigError if the scene cannot be
    # exposed with them
    rehearse: Callable[[], None]


def simulated_devices(
    config: Config, simulation: SimulationSection, clock: Clock, opened: ExitStack
) -> tuple[Devices, SimulatedScene]:
    """Connect every device of the configuration. Returns the devices and the true values of the simulated scene.

    Args:
        opened: collects the functions that close the devices.

    Raises:
        ConfigError: the scene is wrong, or the simulated controller does not have a function that the configuration
            uses.
    """
    scene = scene_of(config)
    line = TriggerLine(clock)
    wanted = config.devices.shutter
    controller, url = _wire("stage", config.devices.stage, clock, line)
    stage = config.devices.stage.connect(clock, url)
    opened.callback(stage.close)
    shutter: Shutter = SimulatedShutter()
    beam_is_on = shutter.is_open
    if isinstance(wanted, StageOutputShutter):  # the driver is at one end of the cable, the blade at the other end
        shutter = OutputShutter(
            stage.digital_output(wanted.output), clock, open_high=wanted.open_high, settle=wanted.settle_s
        )
        beam_is_on = partial(_is_at_level, controller, wanted)
    sample: SampleMover
    sample = simulated = SimulatedSampleMover()
    place: Callable[[], float | None] = simulated.place
    if isinstance(mover := config.devices.sample_mover, StageMover):
        axis = TriggerLine(clock)
        sample = motor = mover.connect(clock, _wire("sample_mover.stage", mover.stage, clock, axis)[1])
        opened.callback(motor.close)
        place = partial(_place_of, mover, axis, clock)
    changer: Filter | None = None
    if isinstance(wheel := config.devices.filter, MotorFilter):
        changer = turned = wheel.connect(clock, _wire("filter.stage", wheel.stage, clock, TriggerLine(clock))[1])
        opened.callback(turned.close)
    elif not isinstance(wheel, NoFilter):  # its intensity is that of the scene
        changer = ManualFilter(lambda request: None)
    pitch = config.optics.pixel_size_um * 1e-3
    model = config.devices.camera.model if isinstance(config.devices.camera, SimulatedOrca) else orca_quest.MODEL
    build = OrcaQuestBuild(pixel_pitch=pitch, model=model)
    camera = SimulatedOrcaQuest(scene, line, clock, simulation.seed, beam_is_on, place, build)
    opened.callback(camera.close)
    monochromator: Monochromator | None = None
    if isinstance(section := config.devices.monochromator, SceneMonochromator):
        monochromator = SimulatedMonochromator(
            scene.beam.energy_kev, lambda kev: scene_of(config, kev), camera.show, clock, section.settle_s
        )
    known = SimulatedScene(partial(_truth, camera), _cone(scene), camera.labels_at, partial(_rehearse, camera))
    return Devices(stage, camera, shutter, sample, changer, monochromator), known


def _is_at_level(controller: Controller, shutter: StageOutputShutter) -> bool:
    return controller.output_is_high(shutter.output) is shutter.open_high


def _place_of(mover: StageMover, axis: TriggerLine, clock: Clock) -> float | None:
    """Distance in mm, across the beam, of the sample from its usual position; None: the sample is out of the beam."""
    place, mm = math.degrees(axis.angle_at(clock.now())), mover.mm_per_deg
    is_out = abs(place - mover.out_deg) < IN_PLACE if mm else abs(place - mover.in_deg) >= IN_PLACE
    return None if is_out else (mm or 0.0) * (place - mover.in_deg)


def _wire(device: str, stage: StageSection, clock: Clock, axis: TriggerLine) -> tuple[Controller, str]:
    """A simulated controller that turns `axis`, and its port. Two controllers in one process must not share a port.

    ConfigError: the controller lacks a function that the section of the device uses.
    """
    try:
        controller = WIRES[stage.kind].matching(stage.settings).controller(clock, axis)
    except ValueError as error:
        raise ConfigError(f"devices.{device}.{error}. Nothing was started.") from error
    return controller, register(f"{stage.kind}-{uuid4().hex}", controller)


def scene_of(config: Config, energy: float | None = None) -> Scene:
    """The simulated scene.

    Args:
        energy: energy in keV that a monochromator sets; None: the energy of the scene.

    Raises:
        ConfigError: the scene is wrong, or its beam does not have a single energy. DataError: a volume that the scene
            names cannot be read.
    """
    stated_scene = config.simulation.scene if config.simulation else {}
    # Paths in a scene that is part of the configuration are absolute here.
    folder = config_folder() if isinstance(stated_scene, dict) else (config_folder() / stated_scene).parent
    mapping = scene_mapping(config)
    if energy is not None and isinstance(beam := mapping.get("beam"), dict):
        if wide_band_key := next((name for name in ("spectrum", "tube") if beam.get(name) is not None), ""):
            raise ConfigError(
                f"simulation.scene.beam: set energy_kev instead of {wide_band_key}, because a monochromator gives a "
                "single energy. Nothing was started."
            )
        mapping = mapping | {"beam": beam | {"energy_kev": energy}}
    try:
        phantom = mapping.get("phantom")
        of_files = isinstance(phantom, dict) and not {"file", "labels"}.isdisjoint(phantom)  # these may change
        if of_files:
            scene = load_scene(mapping, volumes_beside(folder))
        else:
            scene = _kept_scene(_StatedScene(repr(mapping), mapping), folder)
    except SceneError as error:
        raise ConfigError(f"simulation.scene: {error}. Nothing was started.") from None
    if _cone(scene) is not None:
        _refuse_unrecordable(config, scene)
    return scene


@dataclass(frozen=True)
class _StatedScene:
    """The plain values of a scene. Scenes with the same text are the same object."""

    text: str
    mapping: Mapping[str, Any] = field(compare=False)


@lru_cache(maxsize=2)
def _kept_scene(stated: _StatedScene, folder: Path) -> Scene:
    """A scene without files. It is built only once for all scans of a queue that use it."""
    return load_scene(stated.mapping, volumes_beside(folder))


def _refuse_unrecordable(config: Config, scene: Scene) -> None:
    """Raise ConfigError for a cone-beam scan that its file could not describe, so that it could not be
    reconstructed."""
    camera, (height, width) = config.devices.camera, orca_quest.SENSOR_SHAPE
    row0, _, rows, _ = camera.roi or (0, 0, height, width)
    if 2 * row0 + rows != height:
        middle_start = (height - rows) // 2
        raise ConfigError(
            f"devices.camera.roi: begin the {rows} rows at row {middle_start}, not at {row0}. The scene has a cone "
            "beam, and its central ray must meet the middle row of the sensor. Nothing was started."
        )
    if config.scan.offset_views:
        raise ConfigError("scan.offset_views needs a parallel beam, but the scene is a cone beam. Nothing was started.")
    if config.optics.axis_col is None:
        raise ConfigError(
            f"set optics.axis_col, here to {axis_col_of(config, scene):g}: the scene is a cone beam, "
            "whose axis cannot be searched during the scan. Nothing was started."
        )


def axis_col_of(config: Config, scene: Scene) -> float:
    """Column of the frame in which the rotation axis of the scene appears."""
    camera, (height, width) = config.devices.camera, orca_quest.SENSOR_SHAPE
    _, col0, _, _ = camera.roi or (0, 0, height, width)
    return ((width - camera.binning) / 2 + scene.axis_offset_px - col0) / camera.binning


def _cone(scene: Scene) -> tuple[float, float] | None:
    beam = scene.beam
    return None if beam.sod is None or beam.sdd is None else (beam.sod, beam.sdd)


def _rehearse(camera: SimulatedOrcaQuest) -> None:

    try:
        camera.rehearse()
    except CannotExposeError as error:
        raise ConfigError(
            f"the simulator cannot compute frames of simulation.scene: {error}. Nothing was started."
        ) from error


def clock_of(kind: str | Speed, not_before: float = 0.0) -> Clock:
    """The clock of the simulation: real, virtual or accelerated. A virtual or accelerated clock starts at `not_before`
    (s since the Unix epoch) or later."""
    if isinstance(kind, Speed):
        return ScaledClock(SystemClock(), kind.speed, not_before)
    return VirtualClock(max(VIRTUAL_START, not_before)) if kind == "virtual" else SystemClock()


def _truth(camera: SimulatedOrcaQuest, grid: Grid) -> Volume:
    # z = 0 of the scene is the middle of the sensor; z = 0 of a reconstruction is the middle of the rows that were
    # read.
    detector = camera.detector
    up = ((detector.shape[0] - 1) / 2 - detector.axis_row) * detector.pitch
    z, y, x = grid.centre
    return Volume(camera.scene.sample.attenuation(replace(grid, centre=(z + up, y, x))), grid)


def simulated_beam_monitor(name: str, config: BeamMonitorSection, clock: Clock) -> str:
    """The URL of the simulated counterpart with this name, which shows a constant intensity."""
    modules = in_folders("simulators.wires", "BEAM_MONITORS")
    wire = import_module(modules[name]).matching(config, clock)
    return register(f"{name}-{uuid4().hex}", wire)
