"""Devices: the composition root, where a configuration becomes stage, camera, shutter, sample mover and beam monitor.

The only module of `beamline` that names a simulator; it imports the ones it needs where it needs them, so that an
instrument loads no simulator and a simulation no vendor library.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self
from uuid import uuid4

import click

from beamline.config import Config, scene_mapping
from beamline.config_devices import (
    DcamOrca,
    ElectrometerConfig,
    NoBeamMonitor,
    PiGcsStageConfig,
    PM16CStageConfig,
    RingCurrentConfig,
    StageConfig,
    StageOutputShutter,
    ZaberStageConfig,
)
from beamline.config_models import Simulation, Speed
from beamline.errors import ConfigError
from beamline.stages import make_stage, output_of, stage_limits
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
    Shutter,
    StageLimits,
    TriggerSource,
)
from drivers.shutter import OutputShutter

if TYPE_CHECKING:
    from drivers.dcam.options import DcamOptions
    from recon.volume import Grid, Volume
    from simulators.camera import SimulatedOrcaQuest
    from simulators.scene import Scene
    from simulators.serial_url import Wire
    from simulators.trigger_line import TriggerLine


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


@contextmanager
def stage_alone(config: Config, clock: Clock | None = None) -> Iterator[RotationStage]:
    """The configured stage without the rest of the instrument. Nothing moves.

    Raises:
        DeviceError: it does not answer.
    """
    if config.simulation is not None:
        with connect(config, clock) as bench:
            yield bench.devices.stage
        return
    with closing(make_stage(config.devices.stage, config.devices.stage.port, clock or SystemClock())) as stage:
        yield stage


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
        limits = stage_limits(stage)
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
    stage = make_stage(config.devices.stage, config.devices.stage.port, clock)
    opened.callback(stage.close)
    camera = DcamCamera(_path(settings.library), settings.index, clock=clock, options=_options(settings))
    opened.callback(camera.close)
    if settings.cool_s:
        click.echo(f"Waiting for a cold sensor, at most {settings.cool_s:g} s.", err=True)
        camera.wait_until_cold(settings.cool_s)
    shutter: Shutter
    if isinstance(config.devices.shutter, StageOutputShutter):
        shutter = _output_shutter(config, config.devices.shutter, stage, clock)
    else:
        shutter = ManualShutter(ask)
    return Devices(stage, camera, shutter, ManualSampleMover(ask))


def _output_shutter(config: Config, shutter: StageOutputShutter, stage: RotationStage, clock: Clock) -> OutputShutter:
    output = output_of(config.devices.stage, stage, shutter.output)
    return OutputShutter(output, clock, open_high=shutter.open_high, settle=shutter.settle_s)


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
    from simulators.shutter import BeamGate, SimulatedSampleMover, SimulatedShutter, WiredShutter
    from simulators.trigger_line import TriggerLine

    scene = _scene(config)
    line = TriggerLine(clock)
    settings, wanted = config.devices.stage, config.devices.shutter
    wire, high = _wire(settings, clock, line)
    # A name of its own for every bench: two in one process must not share a controller.
    stage = make_stage(settings, register(f"{settings.kind}-{uuid4().hex}", wire), clock)
    opened.callback(stage.close)
    shutter: Shutter = SimulatedShutter()
    blade: BeamGate = shutter
    if isinstance(wanted, StageOutputShutter):  # the driver at one end of the cable, the blade at the other
        output = wanted.output
        shutter = _output_shutter(config, wanted, stage, clock)
        blade = WiredShutter(lambda: high(output), wanted.open_high)
    sample = SimulatedSampleMover()
    pitch = config.optics.pixel_size_um * 1e-3
    camera = SimulatedOrcaQuest(scene, line, clock, simulation.seed, blade, sample, pixel_pitch=pitch)
    opened.callback(camera.close)
    return Devices(stage, camera, shutter, sample), _truth(scene, camera)


def _wire(config: StageConfig, clock: Clock, line: TriggerLine) -> tuple[Wire, Callable[[int], bool]]:
    """The simulated controller, built as the configuration says of the real one, and the levels of its outputs."""
    counts = config.counts_per_turn
    match config:
        case PM16CStageConfig():
            from simulators.wires.pm16c import PM16CController

            return PM16CController(clock, line, channel=config.channel, counts_per_turn=counts), lambda number: False
        case PiGcsStageConfig():
            from simulators.wires.pi_gcs import PiGcsController
            from simulators.wires.pi_gcs_axis import Build
            from simulators.wires.pi_gcs_trigger import FirstPulse

            build = Build(
                counts_per_turn=counts,
                low=config.low_deg - 1,
                high=config.high_deg + 1,
                first_pulse=FirstPulse(config.first_pulse),
                max_velocity=config.max_speed_deg_s,
                max_acceleration=config.acceleration_deg_s2,
            )
            pi = PiGcsController(clock, line, axis=config.axis, output=config.trigger_line, build=build)
            return pi, lambda number: pi.box.levels.get(number, False)
        case ZaberStageConfig():
            from simulators.wires.zaber import ZaberController

            zaber = ZaberController(
                clock,
                line,
                counts_per_turn=counts,
                output=config.output,
                active_high=config.active_high,
                address=config.device,
                can_schedule=not config.toggle,
                can_chain=config.chained,
                fires_when_enabled=config.fires_when_enabled,
            )
            return zaber, lambda number: bool(zaber.device.triggers.outputs[number - 1])


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
