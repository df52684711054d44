"""Devices: the composition root, where a configuration becomes stage, camera, shutter, sample mover and beam monitor.

The only module of `beamline` that names a simulator; it imports the ones it needs where it needs them, so that an
instrument loads no simulator and a simulation no vendor library.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self, TypedDict
from uuid import uuid4

import click

from beamline.config import Config, scene_mapping
from beamline.config_devices import (
    DcamOrca,
    ElectrometerConfig,
    NoBeamMonitor,
    PM16CStageConfig,
    RingCurrentConfig,
    StageConfig,
)
from beamline.config_models import Simulation, Speed
from beamline.errors import ConfigError
from drivers import orca_quest
from drivers.beam_monitor import TextBeamMonitor, TextSource
from drivers.beam_monitor_page import PageSource
from drivers.beam_monitor_serial import SerialSource
from drivers.clock import Clock, SystemClock
from drivers.errors import DeviceError
from drivers.manual import Ask, ManualSampleMover, ManualShutter
from drivers.protocols import (
    BeamMonitor,
    CameraSettings,
    CameraTiming,
    Devices,
    RotationStage,
    StageLimits,
    TriggerSource,
)
from drivers.stages.pm16c import PM16CStage
from drivers.stages.pm16c import limits_of as limits_of_pm16c

if TYPE_CHECKING:
    from drivers.dcam.options import DcamOptions
    from recon.volume import Grid, Volume
    from simulators.camera import SimulatedOrcaQuest
    from simulators.scene import Scene
    from simulators.serial_url import Wire
    from simulators.trigger_line import TriggerLine


class _Figures(TypedDict):
    """What a stage is limited to, as every driver takes it: counts, rad/s, rad/s², rad."""

    counts_per_turn: int
    max_speed: float
    acceleration: float
    low: float
    high: float


class _Wiring(TypedDict):
    """How a stage is connected, as every driver takes it; s."""

    clock: Clock
    timeout: float
    baudrate: int
    pulse_width: float | None
    active_high: bool
    transcript: Path | None


@dataclass(frozen=True)
class Bench:
    """Connected devices and what goes with them; leaving a `with` block closes them.

    Attributes:
        clock: what every wait of the run goes by.
        truth: the simulated sample's attenuation on a grid whose z is measured, as reconstructions do it, from the
            middle of the camera's rows; None at a real instrument.
        close: frees ports and camera; a second time does nothing.
        beam_monitor: None where none is configured.
    """

    devices: Devices
    clock: Clock
    truth: Callable[[Grid], Volume] | None
    close: Callable[[], None]
    beam_monitor: BeamMonitor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def connect(config: Config, clock: Clock | None = None, ask: Ask | None = None) -> Bench:
    """Open every device that the configuration names. Nothing moves.

    Args:
        clock: takes the place of the configured one.
        ask: puts a request to the operator (manual shutter and sample mover); the terminal unless given.

    Raises:
        DeviceError: a device does not answer; those opened before it are closed again.
        ConfigError: the simulated scene is wrong.
    """
    with ExitStack() as opened:
        if config.simulation is None:
            clock, truth = clock or SystemClock(), None
            devices = _instrument(config, clock, ask or ask_operator, opened)
        else:
            clock = clock or _clock(config.simulation.clock)
            devices, truth = _simulated(config, config.simulation, clock, opened)
        monitor = None
        if not isinstance(config.devices.beam_monitor, NoBeamMonitor):
            monitor = beam_monitor(config.devices.beam_monitor, clock)
            opened.callback(monitor.close)
        return Bench(devices, clock, truth, opened.pop_all().close, monitor)


def describe(config: Config) -> tuple[StageLimits, CameraTiming, Callable[[float], int]]:
    """What the devices will say once connected, from the configuration and the data sheet alone: for dry runs.

    A simulated scene is read too, so that what is wrong with it is said now.

    Returns:
        the stage's limits, the camera's timing with the views' exposure, and the stage's radians to whole counts.

    Raises:
        ConfigError: settings that a device would refuse, or a scene that is wrong.
    """
    stage = config.devices.stage
    if config.simulation is not None:
        _scene(config)
    try:
        limits = _limits(stage)
    except ValueError as error:
        raise ConfigError(f"devices.stage: {error}. Nothing was started.") from None
    settings = camera_settings(config, config.scan.exposure_s, TriggerSource.EXTERNAL)
    link = config.devices.camera.link if isinstance(config.devices.camera, DcamOrca) else "usb3"
    try:
        timing = orca_quest.timing(settings, link)
    except ValueError as error:
        raise ConfigError(f"devices.camera: {error}. Nothing was started.") from None
    return limits, timing, lambda angle: round(angle * stage.counts_per_turn / (2 * math.pi))


def beam_monitor(config: ElectrometerConfig | RingCurrentConfig, clock: Clock) -> BeamMonitor:
    """The beam monitor that is configured; the simulated electrometer shows a steady current.

    Raises:
        DeviceError: the electrometer's port does not open.
    """
    source: TextSource
    if isinstance(config, RingCurrentConfig):
        source = PageSource(config.url, clock, timeout=config.timeout_s)
    else:
        end = {"crlf": b"\r\n", "cr": b"\r", "lf": b"\n"}[config.line_end]
        source = SerialSource(
            _electrometer(clock, end) if config.simulated else config.port,
            clock,
            query=config.query,
            pattern=config.pattern,
            setup=config.setup,
            timeout=config.timeout_s,
            baudrate=config.baudrate,
            line_end=end,
            transcript=_path(config.transcript),
        )
    return TextBeamMonitor(source, clock, pattern=config.pattern, unit=config.unit, scale=config.scale)


def camera_settings(config: Config, exposure: float, trigger: TriggerSource) -> CameraSettings:
    """The configured region, binning and readout with an exposure (s) and a trigger source."""
    camera = config.devices.camera
    return CameraSettings(exposure, trigger, camera.roi, camera.binning, camera.readout)


def ask_operator(request: str) -> None:
    """Put a request to whoever sits at the terminal, and wait for Enter.

    Raises:
        DeviceError: nobody sits there.
    """
    if not sys.stdin.isatty():
        raise DeviceError(
            "operator",
            "there is no terminal to ask at",
            request=request,
            advice="Run it in a terminal, or configure a shutter and a sample mover that need no hand",
            state="What was acquired so far is in the file",
        )
    try:
        # A read from a terminal goes on after a signal, so that a stop is heeded only once it returns.
        how = "Then press Enter (to stop the scan: Ctrl-C, then Enter)"
        click.prompt(f"{request} {how}", default="", show_default=False, prompt_suffix=" ", err=True)
    except click.Abort as error:  # the end of input
        raise DeviceError(
            "operator",
            "the request was not confirmed",
            request=request,
            state="What was acquired so far is in the file",
        ) from error


def _instrument(config: Config, clock: Clock, ask: Ask, opened: ExitStack) -> Devices:
    from drivers.dcam.camera import DcamCamera

    settings = config.devices.camera
    if not isinstance(settings, DcamOrca):
        raise ConfigError("a real stage goes with a real camera; set devices.camera.kind: dcam")
    stage = _stage(config.devices.stage, config.devices.stage.port, clock)
    opened.callback(stage.close)
    camera = DcamCamera(_path(settings.library), settings.index, clock=clock, options=_options(settings))
    opened.callback(camera.close)
    if settings.cool_s:
        click.echo(f"Waiting for a cold sensor, at most {settings.cool_s:g} s.", err=True)
        camera.wait_until_cold(settings.cool_s)
    return Devices(stage, camera, ManualShutter(ask), ManualSampleMover(ask))


def _options(camera: DcamOrca) -> DcamOptions:
    from drivers.dcam import options

    return options.DcamOptions(
        trigger_active=options.TriggerActive(camera.trigger_active),
        trigger_mode=options.TriggerMode(camera.trigger_mode),
        trigger_polarity=options.TriggerPolarity(camera.trigger_polarity),
        global_exposure=options.GlobalExposure(camera.global_exposure),
        trigger_times=camera.trigger_times,
        trigger_delay=camera.trigger_delay_s,
        hot_pixels=None if camera.hot_pixels is None else options.HotPixels(camera.hot_pixels),
        exposure_tolerance=camera.exposure_tolerance,
        ring_bytes=camera.ring_mb * 1_000_000,
    )


def _simulated(
    config: Config, simulation: Simulation, clock: Clock, opened: ExitStack
) -> tuple[Devices, Callable[[Grid], Volume]]:
    from simulators.camera import SimulatedOrcaQuest
    from simulators.serial_url import register
    from simulators.shutter import SimulatedSampleMover, SimulatedShutter
    from simulators.trigger_line import TriggerLine

    scene = _scene(config)
    line = TriggerLine(clock)
    settings = config.devices.stage
    # A name of its own for every bench: two in one process must not share a controller.
    stage = _stage(settings, register(f"{settings.kind}-{uuid4().hex}", _wire(settings, clock, line)), clock)
    opened.callback(stage.close)
    shutter, sample = SimulatedShutter(), SimulatedSampleMover()
    pitch = config.optics.pixel_size_um * 1e-3
    camera = SimulatedOrcaQuest(scene, line, clock, simulation.seed, shutter, sample, pixel_pitch=pitch)
    opened.callback(camera.close)
    return Devices(stage, camera, shutter, sample), _truth(scene, camera)


def _wire(config: StageConfig, clock: Clock, line: TriggerLine) -> Wire:
    """The simulated controller, set up as the configuration says of the real one."""
    match config:
        case PM16CStageConfig():
            from simulators.wires.pm16c import PM16CController

            return PM16CController(clock, line, channel=config.channel, counts_per_turn=config.counts_per_turn)
    raise ConfigError(f"devices.stage: {config.kind} has no simulated counterpart yet")


def _electrometer(clock: Clock, end: bytes) -> str:
    from simulators.serial_url import register
    from simulators.wires.electrometer import ElectrometerWire

    return register(f"electrometer-{uuid4().hex}", ElectrometerWire(clock, end=end))


def _scene(config: Config) -> Scene:
    from simulators.mapping import SceneError
    from simulators.scene import load_scene

    try:
        return load_scene(scene_mapping(config))
    except SceneError as error:
        raise ConfigError(f"simulation.scene: {error}. Nothing was started.") from None


def _stage(config: StageConfig, url: str, clock: Clock) -> RotationStage:
    """The driver for the configured controller at `url`; each is imported where it is asked for."""
    wiring, figures = _wiring(config, clock), _figures(config)
    match config:
        case PM16CStageConfig():
            home, home_speed = _radians(config.home_deg), _radians(config.home_speed_deg_s)
            return PM16CStage(url, channel=config.channel, home=home, home_speed=home_speed, **wiring, **figures)
    raise ConfigError(f"devices.stage: {config.kind} has no driver yet")


def _limits(config: StageConfig) -> StageLimits:
    """What the driver will say of the stage, as far as that is known without it. Raises ValueError."""
    figures = _figures(config)
    if isinstance(config, PM16CStageConfig):
        return limits_of_pm16c(**figures)
    return StageLimits(**figures, trigger_output=True)


def _figures(config: StageConfig) -> _Figures:
    return {
        "counts_per_turn": config.counts_per_turn,
        "max_speed": math.radians(config.max_speed_deg_s),
        "acceleration": math.radians(config.acceleration_deg_s2),
        "low": math.radians(config.low_deg),
        "high": math.radians(config.high_deg),
    }


def _wiring(config: StageConfig, clock: Clock) -> _Wiring:
    return {
        "clock": clock,
        "timeout": config.timeout_s,
        "baudrate": config.baudrate,
        "pulse_width": config.pulse_width_s,
        "active_high": config.active_high,
        "transcript": _path(config.transcript),
    }


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)


def _path(text: str | None) -> Path | None:
    return None if text is None else Path(text)


def _clock(kind: str | Speed) -> Clock:
    from simulators.clock import ScaledClock, VirtualClock

    if isinstance(kind, Speed):
        return ScaledClock(SystemClock(), kind.speed)
    return VirtualClock() if kind == "virtual" else SystemClock()


def _truth(scene: Scene, camera: SimulatedOrcaQuest) -> Callable[[Grid], Volume]:
    from recon.volume import Volume

    def truth(grid: Grid) -> Volume:
        # The scene's z = 0 is the middle of the sensor, a reconstruction's the middle of the rows that were read.
        detector = camera.detector
        up = ((detector.shape[0] - 1) / 2 - detector.axis_row) * detector.pitch
        z, y, x = grid.centre
        return Volume(scene.phantom.attenuation(replace(grid, centre=(z + up, y, x))), grid)

    return truth
