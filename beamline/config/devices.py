"""Configuration of the devices: stage, camera, shutter, beam monitor and what moves in the beam, real or simulated."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Self, Union

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from beamline.config.monochromator import MonochromatorConfig, NoMonochromator
from beamline.config.places import (
    FilterConfig,
    MotorSection,
    NoFilter,
    PvUrl,
    PvValue,
    Seconds,
    StageMover,
    without,
)
from beamline.config.section import Section, declared, read_from, section_of
from beamline.config.stages import StageConfig
from drivers import orca_quest
from drivers.base.clock import Clock
from drivers.base.protocols import Camera, CameraSettings, CameraTiming
from drivers.beam_monitors.reading import PATTERN, QUERY, pattern_problem, url_problem
from drivers.cameras import CAMERAS
from drivers.epics.devices import ShutterPvs
from drivers.stages.registry import STAGES

Roi = Annotated[
    tuple[
        Annotated[int, Field(ge=0)],
        Annotated[int, Field(ge=0)],
        Annotated[int, Field(ge=1)],
        Annotated[int, Field(ge=1)],
    ],
    Field(description="row0, col0, rows, cols on the sensor, all multiples of 4"),
]


class _Orca(Section):
    """The keys that the real and the simulated ORCA-Quest share."""

    kind: str
    model: Literal["C15550-20UP", "C15550-22UP"] = "C15550-20UP"
    """ORCA-Quest, or ORCA-Quest 2, which reads ultra quiet five times as fast; plans and simulations go by it."""
    roi: Roi | None = None
    """null: the full sensor, 2304 x 4096."""
    binning: Literal[1, 2, 4] = 1
    readout: Literal["standard", "ultra_quiet", "photon_number"] = "standard"
    """photon_number: the camera counts photoelectrons, at the pace of ultra_quiet."""
    trigger_polarity: Literal["positive", "negative"] = "positive"
    """The edge that counts; a camera that was just switched on takes negative, the driver sets what stands here."""

    def timing_of(self, wanted: CameraSettings) -> CameraTiming:
        """What the camera will say of its timing. ValueError for what it would refuse."""
        return orca_quest.timing(wanted, model=self.model)


class SimulatedOrca(_Orca):
    kind: Literal["simulated_orca"]


class DcamOrca(_Orca):
    kind: Literal["dcam"]
    library: str | None = None
    """Path of the DCAM-API library; null: the installed one."""
    index: Annotated[int, Field(ge=0)] = 0
    """Which camera, where DCAM finds several."""
    link: Literal["usb3", "coaxpress"] = "usb3"
    """USB3 carries 17.7 full frames a second, CoaXPress 120."""
    trigger_active: Literal["edge", "level", "sync_readout"] = "edge"
    """edge: a pulse begins an exposure of exposure_s. level: the pulse's length is the exposure; set exposure_s to it.
    sync_readout: a pulse ends an exposure and begins the next; n pulses give n - 1 frames, which no fly scan takes."""
    trigger_mode: Literal["normal", "start"] = "normal"
    """start: the first pulse begins a free run, which no fly scan takes."""
    trigger_times: Annotated[int, Field(ge=1, le=10_000)] = 1
    """Every so many pulses make one frame; a fly scan takes 1."""
    trigger_delay_s: Annotated[float, Field(ge=0, le=10)] = 0.0
    """From a pulse to the exposure; the angle in the file stays that of the pulse."""
    global_exposure: Literal["delayed", "global_reset"] = "delayed"
    """delayed: rolling shutter. global_reset: all rows begin at once, later rows expose longer unless light is cut."""
    hot_pixels: Literal["minimum", "standard", "aggressive"] | None = None
    """null: counts as measured; else the camera repairs defects with this sensitivity, which alters data."""
    exposure_tolerance: Annotated[float, Field(ge=0)] = 0.01
    """By which fraction (and one line time) the camera may change an exposure before it is refused."""
    cool_s: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Wait at most so long for the sensor to be cold before a scan; 0: do not wait."""
    ring_mb: Annotated[int, Field(gt=0, le=1_000_000)] = 1000
    """Most memory for the ring; a full frame has 18.9 MB."""
    usb_product: Annotated[int, Field(ge=0, le=0xFFFF)] | None = None
    """USB product id, for the doctor; null: any of the vendor's (which makes other things too)."""
    usb_serial: str | None = None
    """USB serial number, for the doctor, where there are several cameras."""

    def timing_of(self, wanted: CameraSettings) -> CameraTiming:
        return orca_quest.timing(wanted, self.link, self.model)


class PluggedCamera(Section):
    """A camera of another package, with the keys that its settings declare."""

    kind: str
    roi: tuple[NonNegativeInt, NonNegativeInt, PositiveInt, PositiveInt] | None = None
    """row0, col0, rows, cols on the sensor; null: all of it."""
    binning: PositiveInt = 1
    readout: str = "standard"

    def timing_of(self, wanted: CameraSettings) -> CameraTiming:
        """What the camera will say of its timing. ValueError for what it would refuse."""
        driver = CAMERAS[self.kind]
        return driver.timing_of(read_from(self, driver.Settings), wanted)

    def connect(self, clock: Clock) -> Camera:
        """Its driver, connected; see `CameraDriver`."""
        driver = CAMERAS[self.kind]
        return driver(read_from(self, driver.Settings), clock)


def _plugged(kind: str) -> type[PluggedCamera]:
    keys = {"kind": (Literal[kind], ...)} | declared(CAMERAS[kind].Settings)
    return section_of(f"{kind.title()}CameraConfig", PluggedCamera, keys)


PLUGGED: tuple[type[PluggedCamera], ...] = tuple(map(_plugged, CAMERAS))  # Sections of the cameras of other packages

if TYPE_CHECKING:
    CameraConfig = SimulatedOrca | DcamOrca | PluggedCamera
else:
    CameraConfig = Union[(SimulatedOrca, DcamOrca, *PLUGGED)]


class Simple(Section):
    """A device with nothing to set: simulated, or manual (the operator is asked to do it)."""

    kind: Literal["simulated", "manual"]


class StageOutputShutter(Section):
    """A shutter on a digital output of the stage's controller, where that has outputs that can be set."""

    kind: Literal["stage_output"]
    output: PositiveInt
    """Number of the output; not the one that the trigger pulses come from."""
    open_high: bool = True
    """A high output opens."""
    settle_s: Annotated[float, Field(ge=0)] = 0.1
    """How long the blade travels."""


Pattern = Annotated[str, without(pattern_problem)]


class EpicsShutter(Section):
    """A shutter behind EPICS process variables, each as pva://NAME or ca://NAME."""

    kind: Literal["epics"]
    open_pv: PvUrl
    open_value: PvValue = 1.0
    """Written to open_pv to open it: a number, a text or a label."""
    close_pv: PvUrl | None = None
    """null: open_pv, which then takes both values."""
    close_value: PvValue = 0.0
    status_pv: PvUrl
    """Where the blade itself is read; open_pv where there is nothing better."""
    status_open: PvValue = 1.0
    """Its value or label while the shutter is open; anything else is closed."""
    timeout_s: Seconds = 2.0
    """For an answer of the IOC."""
    travel_s: Seconds = 10.0
    """The longest that the status may take to follow."""

    @property
    def pvs(self) -> ShutterPvs:
        """In the driver's terms."""
        closing = self.close_pv or self.open_pv
        values = self.open_value, self.close_value, self.status_open
        return ShutterPvs(self.open_pv, closing, self.status_pv, *values, self.timeout_s, self.travel_s)


class _BeamMonitor(Section):
    """What every beam monitor has."""

    unit: str
    scale: PositiveFloat = 1.0
    """What the number is multiplied by to be in `unit`."""
    timeout_s: Annotated[float, Field(gt=0, le=1e6)] = 2.0
    period_s: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    """Between readings while a scan runs (real time); they are kept in the scan's file."""
    pause_below: PositiveFloat | None = None
    """In `unit`: a scan pauses while there is less; null: it never does."""
    resume_above: PositiveFloat | None = None
    """In `unit`: from here on there is beam again; null: a tenth above pause_below."""
    settle_s: Annotated[float, Field(ge=0)] = 5.0
    """For which there must be beam again before the scan goes on."""

    @model_validator(mode="after")
    def _resumes_where_it_would_not_pause(self) -> Self:
        if self.pause_below is None and self.resume_above is not None:
            raise ValueError("resume_above has no meaning without pause_below: set both, or neither")
        if self.pause_below is not None and self.resumes_at < self.pause_below:
            raise ValueError(f"resume_above {self.resumes_at:g} is below pause_below {self.pause_below:g}")
        return self

    @property
    def resumes_at(self) -> float:
        """In `unit`."""
        return self.resume_above or 1.1 * (self.pause_below or 0.0)


class NoBeamMonitor(Section):
    kind: Literal["none"] = "none"


class ElectrometerConfig(_BeamMonitor):
    """An electrometer or picoammeter on a serial port that answers a query with a line that holds a number."""

    kind: Literal["electrometer"]
    port: Annotated[str, Field(min_length=1)]
    """A serial port, socket://host:port, or sim://electrometer."""
    query: Annotated[str, Field(min_length=1)] = QUERY
    pattern: Pattern = PATTERN
    """Regular expression whose first group is the number."""
    unit: str = "A"
    setup: tuple[str, ...] = ()
    """Commands without a reply, sent once at the start."""
    line_end: Literal["crlf", "cr", "lf"] = "crlf"
    baudrate: PositiveInt = 9600
    transcript: str | None = None
    """As the stage's."""

    @property
    def simulated(self) -> bool:
        return self.port.lower().startswith("sim://")


class RingCurrentConfig(_BeamMonitor):
    """The ring current from a page or a text file."""

    kind: Literal["ring_current"]
    url: Annotated[str, without(url_problem)]
    """http://..., https://... or file:///..."""
    pattern: Pattern
    """Regular expression whose first group is the number."""
    unit: str = "mA"


class EpicsBeamConfig(_BeamMonitor):
    """The ring current, or an intensity, from an EPICS process variable."""

    kind: Literal["epics"]
    pv: PvUrl
    """pva://NAME or ca://NAME."""
    unit: str = "mA"


BeamMonitorConfig = NoBeamMonitor | ElectrometerConfig | RingCurrentConfig | EpicsBeamConfig


def _simulated(device: Simple | StageMover | FilterConfig) -> bool:
    return device.stage.simulated if isinstance(device, MotorSection) else device.kind == "simulated"


class DeviceSection(Section):
    stage: Annotated[StageConfig, Field(discriminator="kind")]
    camera: Annotated[CameraConfig, Field(discriminator="kind")]
    shutter: Annotated[Simple | StageOutputShutter | EpicsShutter, Field(discriminator="kind")]
    sample_mover: Annotated[Simple | StageMover, Field(discriminator="kind")]
    filter: Annotated[FilterConfig, Field(discriminator="kind")] = NoFilter()
    monochromator: Annotated[MonochromatorConfig, Field(discriminator="kind")] = NoMonochromator()
    beam_monitor: Annotated[BeamMonitorConfig, Field(discriminator="kind")] = NoBeamMonitor()

    @model_validator(mode="after")
    def _edges_agree(self) -> Self:
        camera, high = self.camera, self.stage.settings.wiring.active_high
        if isinstance(camera, SimulatedOrca) and (camera.trigger_polarity == "positive") is not high:
            raise ValueError(
                f"stage.active_high {str(high).lower()} does not go with camera.trigger_polarity "
                f"{camera.trigger_polarity}: the simulated cable has no inverter, and every exposure would begin at "
                f"its pulse's end; set trigger_polarity {'positive' if high else 'negative'}"
            )
        return self

    @model_validator(mode="after")
    def _output_is_free(self) -> Self:
        taken, shutter = self.stage.settings.pulse_output, self.shutter
        if not isinstance(shutter, StageOutputShutter):
            return self
        if taken is None:
            with_outputs = [kind for kind, driver in STAGES.items() if driver.Settings.pulse_output is not None]
            raise ValueError(
                f"shutter.kind: a {self.stage.kind} stage has no digital output for a shutter; set it to manual, or "
                f"use the output of another controller (stage.kind {' or '.join(with_outputs)})"
            )
        if shutter.output == taken:
            raise ValueError(f"shutter.output {taken} is the output that the stage's trigger pulses come from")
        return self

    @model_validator(mode="after")
    def _port_is_free(self) -> Self:
        taken = {self.stage.port: "devices.stage"}
        for name, device in (("sample_mover", self.sample_mover), ("filter", self.filter)):
            if not isinstance(device, MotorSection) or device.stage.simulated:
                continue
            if (port := device.stage.port) in taken:
                raise ValueError(
                    f"{name}.stage.port {port} is that of {taken[port]}, and a port is opened once; the "
                    f"{name.replace('_', ' ')} needs a controller, or a record, of its own"
                )
            taken[port] = f"devices.{name}"
        return self

    def simulated_or_not(self) -> dict[str, bool]:
        """Each device that can be simulated, and whether it is."""
        stage, shutter = self.stage.simulated, self.shutter.kind
        simulated = {
            "stage": stage,
            "camera": self.camera.kind == "simulated_orca",
            "shutter": shutter == "simulated" or (shutter == "stage_output" and stage),
            "sample_mover": _simulated(self.sample_mover),
        }
        if not isinstance(self.filter, NoFilter):
            simulated["filter"] = _simulated(self.filter)
        if not isinstance(self.monochromator, NoMonochromator):
            simulated["monochromator"] = self.monochromator.kind == "simulated"
        if isinstance(self.beam_monitor, ElectrometerConfig):
            simulated["beam_monitor"] = self.beam_monitor.simulated
        return simulated
