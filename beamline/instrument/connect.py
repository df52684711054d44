"""Connects all devices of an instrument, as the configuration states them.

A separate module connects each kind of device. If the instrument is simulated, the module `simulated` makes all
devices. It is the only module that imports a simulator.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Protocol, Self, TypeVar

import click

from beamline.config.beam import (
    BeamMonitorSection,
    FoundFilter,
    FoundMonochromator,
    FoundShutter,
    MotorFilter,
    NoFilter,
    NoMonochromator,
    StageMover,
    StageOutputShutter,
)
from beamline.config.devices import DcamOrca, SimulatedOrca
from beamline.config.load import Config
from beamline.config.planned import camera_settings
from beamline.core.errors import ConfigError
from drivers.base.clock import Clock, SystemClock
from drivers.base.protocols import (
    BeamMonitor,
    Camera,
    CameraTiming,
    ConnectedShutter,
    CooledCamera,
    Devices,
    Filter,
    Monochromator,
    RotationStage,
    Shutter,
    StageLimits,
    TriggerSource,
    Watchable,
)
from drivers.frame_memory import FrameMemory
from drivers.in_beam import Ask, ManualFilter, ManualMonochromator, ManualSampleMover, ManualShutter, OutputShutter
from drivers.stages.travel import Travel

if sys.platform == "win32":
    import msvcrt
else:
    import select


from drivers.base.errors import DeviceError

_STATE = "Frames taken so far are in the file"


def ask_operator(request: str) -> None:
    """Ask the operator at the terminal, and wait for Enter. Raises DeviceError without a terminal or a confirmation."""
    if not sys.stdin.isatty():
        advice = "Run the scan in a terminal, or configure a shutter and a sample mover that are not moved by hand"
        raise DeviceError(
            "operator", "there is no terminal to ask the operator", request=request, advice=advice, state=_STATE
        )
    try:
        # After a signal, a read from a terminal continues, so that a stop takes effect only when the read returns.
        how = "Then press Enter (to stop the scan: Ctrl-C, then Enter)"
        click.prompt(f"{request} {how}", default="", show_default=False, prompt_suffix=" ", err=True)
    except click.Abort as error:  # the end of input
        raise DeviceError("operator", "the request was not confirmed", request=request, state=_STATE) from error


def enter_pressed() -> bool:
    """Whether Enter was pressed at the terminal since the last call; False if there is no terminal. The function does
    not wait."""
    pressed = False
    if not sys.stdin.isatty():
        return False
    if sys.platform == "win32":
        while msvcrt.kbhit():
            pressed |= msvcrt.getwch() in "\r\n"
    else:
        while select.select([sys.stdin], [], [], 0)[0] and sys.stdin.readline():
            pressed = True
    return pressed


if TYPE_CHECKING:
    from beamline.instrument.simulated import SimulatedScene
    from recon.base.volume import Grid, Volume


class Closable(Protocol):
    def close(self) -> None: ...


Connected = TypeVar("Connected", bound=Closable)
TELL_EVERY = 30.0  # s between messages while the sensor is cooling down


def make_camera(config: DcamOrca, clock: Clock, memory: FrameMemory | None = None) -> CooledCamera:
    """Connect the configured camera. `memory` is the memory for its frames.

    Raises: DeviceError: the library or the camera is missing, or the camera does not count its frames.
    """
    camera: CooledCamera = import_module(f"drivers.{config.kind}.camera").configured(config, clock, memory)
    return camera


def wait_until_cold(camera: CooledCamera, seconds: float, clock: Clock, check_stop: Callable[[], None]) -> None:
    """Wait until the sensor is cold, and report its temperature to the operator.

    Args:
        seconds: longest wait in s. check_stop: function that is called once a second; an exception from it ends the
            wait.

    Raises: DeviceError: the sensor does not get cold, or its cooler is off or reports a fault.
    """
    click.echo(f"Waiting until the sensor is cold, at most {seconds:g} s; Ctrl-C ends the wait.", err=True)
    reported = -math.inf

    def progress(celsius: float, status: str) -> None:
        nonlocal reported
        check_stop()
        if clock.now() - reported >= TELL_EVERY:
            reported = clock.now()
            click.echo(f"The sensor is at {celsius:.1f} °C; its cooler reports {status}.", err=True)

    camera.wait_until_cold(seconds, progress)


def make_beam_monitor(config: BeamMonitorSection, clock: Clock) -> BeamMonitor:
    """Connect the configured beam monitor. A simulated beam monitor shows a constant intensity.

    Raises: DeviceError: its port cannot be opened.
    """
    if not config.simulated or config.counterpart is None:
        return config.connect(clock, None)
    from beamline.instrument.simulated import simulated_beam_monitor

    return config.connect(clock, simulated_beam_monitor(config.counterpart, config, clock))


@dataclass(frozen=True)
class ConnectedDevices:
    """Connected devices, with everything that a run needs for them. Leaving a `with` block closes the devices.

    Attributes:
        clock: clock for every wait of the run. simulated: facts from the simulator; None for a real instrument. close:
            function that frees ports and camera; a second call does nothing. beam_monitor: the beam monitor; None if
            none is configured.
        frame_memory: memory for the frames of the camera; None for a simulated camera.
        watch_moves: function that sets another function, which is called repeatedly while a device moves; an exception
            from the latter ends the move.
    """

    devices: Devices
    clock: Clock
    simulated: SimulatedScene | None
    close: Callable[[], None]
    beam_monitor: BeamMonitor | None = None
    frame_memory: FrameMemory | None = None
    watch_moves: Callable[[Callable[[], None]], None] = lambda check: None

    @property
    def truth(self) -> Callable[[Grid], Volume] | None:
        """The ground truth of the scene, see `SimulatedScene.truth`; None for a real instrument."""
        return None if self.simulated is None else self.simulated.truth

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def connect(
    config: Config, clock: Clock | None = None, ask: Ask | None = None, check_stop: Callable[[], None] = lambda: None
) -> ConnectedDevices:
    """Open every device that the configuration names. Nothing moves.

    Args:
        clock: replaces the configured clock.
        ask: function that asks the operator to move shutter or sample by hand; default: ask at the terminal.
        check_stop: function that is called repeatedly during waits; an exception from it ends the wait.

    Raises:
        DeviceError: a device does not answer. `connect` closes the devices that it had already opened.
        ConfigError: the simulated scene is wrong.
    """
    with ExitStack() as opened:
        if config.simulation is None:
            clock, simulated, memory = clock or SystemClock(), None, FrameMemory()
            ask = ask or ask_operator
            devices = _instrument(config, clock, ask, check_stop, opened, memory)
            if isinstance(chosen := config.devices.sample_mover, StageMover):
                devices = replace(devices, sample=_held(chosen.connect(clock), opened))
            devices = replace(
                devices,
                filter=_filter(config, clock, ask, opened),
                monochromator=_monochromator(config, clock, ask, opened),
            )
        else:
            from beamline.instrument.simulated import clock_of, simulated_devices

            clock, memory = clock or clock_of(config.simulation.clock), None
            devices, simulated = simulated_devices(config, config.simulation, clock, opened)
        monitor = None
        if isinstance(wanted := config.devices.beam_monitor, BeamMonitorSection):
            monitor = _held(make_beam_monitor(wanted, clock), opened)

        def watch(check: Callable[[], None]) -> None:
            for device in (devices.shutter, devices.sample, devices.filter, devices.monochromator):
                if isinstance(device, Watchable):
                    device.watch(check)

        return ConnectedDevices(devices, clock, simulated, opened.pop_all().close, monitor, memory, watch)


def clock_after(config: Config, time: float) -> Clock | None:
    """The simulated clock of this process, started at `time` (s since the Unix epoch). Each process has its own clock.
    None: the clock is not simulated.
    """
    if config.simulation is None:
        return None
    from beamline.instrument.simulated import clock_of

    return clock_of(config.simulation.clock, not_before=time)


@contextmanager
def stage_alone(config: Config) -> Iterator[RotationStage]:
    """Connect the configured stage without the rest of the instrument. Nothing moves. Raises DeviceError if it does not
    answer.
    """
    if config.simulation is not None:
        with connect(config) as instrument:
            yield instrument.devices.stage
    else:
        with closing(config.devices.stage.connect(SystemClock())) as stage:
            yield stage


def describe(config: Config) -> tuple[StageLimits, CameraTiming, Callable[[float], int]]:
    """The limits and timing of the devices, from the configuration and the data sheets alone. Dry runs use them.

    A simulated scene is also read, so that its faults are reported now.

    Returns:
        the limits of the stage, the timing of the camera for the exposure of the projections, and the conversion of the
        stage from radians to whole counts.

    Raises:
        ConfigError: a device would not accept the settings, or the scene is wrong.
    """
    limits = config.devices.stage.settings.limits()
    if config.simulation is not None:
        from beamline.instrument.simulated import scene_of

        scene_of(config, config.scan.energy)
    settings = camera_settings(config, config.scan.exposure_s, TriggerSource.EXTERNAL)
    try:
        timing = config.devices.camera.timing_of(settings)
    except ValueError as error:
        raise ConfigError(f"devices.camera: {error}. Nothing was started.") from None
    return limits, timing, Travel("stage", limits).to_counts


def _held(device: Connected, opened: ExitStack) -> Connected:
    """The device; it is closed at the end of the context."""
    opened.callback(device.close)
    return device


def _instrument(
    config: Config, clock: Clock, ask: Ask, check_stop: Callable[[], None], opened: ExitStack, memory: FrameMemory
) -> Devices:
    chosen = config.devices.camera
    if isinstance(chosen, SimulatedOrca):
        raise ConfigError("a real stage needs a real camera; set devices.camera.kind: dcam")
    stage = _held(config.devices.stage.connect(clock), opened)
    camera: Camera
    if isinstance(chosen, DcamOrca):
        camera = orca = _held(make_camera(chosen, clock, memory), opened)
        if chosen.cool_s:
            wait_until_cold(orca, chosen.cool_s, clock, check_stop)
    else:
        camera = _held(chosen.connect(clock), opened)
    shutter = shutter_of(config, stage, clock, ask)
    if isinstance(shutter, ConnectedShutter):
        opened.callback(shutter.disconnect)
    return Devices(stage, camera, shutter, ManualSampleMover(ask))


def _filter(config: Config, clock: Clock, ask: Ask, opened: ExitStack) -> Filter | None:
    wanted = config.devices.filter
    if isinstance(wanted, MotorFilter | FoundFilter):
        return _held(wanted.connect(clock), opened)
    return None if isinstance(wanted, NoFilter) else ManualFilter(ask)


def _monochromator(config: Config, clock: Clock, ask: Ask, opened: ExitStack) -> Monochromator | None:
    wanted = config.devices.monochromator
    if isinstance(wanted, FoundMonochromator):
        return _held(wanted.connect(clock), opened)
    return None if isinstance(wanted, NoMonochromator) else ManualMonochromator(ask)


def shutter_of(config: Config, stage: RotationStage, clock: Clock, ask: Ask) -> Shutter:
    """The configured shutter of a real instrument."""
    wanted = config.devices.shutter
    if isinstance(wanted, FoundShutter):
        return wanted.connect(clock)
    if not isinstance(wanted, StageOutputShutter):
        return ManualShutter(ask)
    output = stage.digital_output(wanted.output)
    return OutputShutter(output, clock, open_high=wanted.open_high, settle=wanted.settle_s)
