"""Configuration of the devices: stage, camera, shutter, beam monitor and devices that move in the beam, real or
simulated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, Self, Union

from pydantic import Field, model_validator

from beamline.config.beam import (
    BeamMonitorSection,
    FoundFilter,
    FoundMonochromator,
    FoundShutter,
    HandMonochromator,
    MotorFilter,
    MotorSection,
    NamedFilter,
    NoBeamMonitor,
    NoFilter,
    NoMonochromator,
    SceneMonochromator,
    StageMover,
    StageOutputShutter,
)
from beamline.config.section import Section, declared, read_from, section_of
from beamline.config.stages import STAGES, StageConfig
from drivers import orca_quest
from drivers.base.clock import Clock
from drivers.base.protocols import Camera, CameraSettings, CameraTiming
from drivers.orca_quest import DcamOptions
from drivers.stages.settings import with_settings
from recon.base.registry import Registry, in_folders
from recon.base.setting import Setting, setting


class CameraDriver(Protocol):
    """The class of a driver, which the entry point of a package names.

    Attributes:
        Settings: a frozen dataclass with the settings of the driver. Each field declares, with a `Setting`, how a
            configuration writes it.
    """

    Settings: type[Any]

    def __call__(self, settings: Any, clock: Clock) -> Camera:
        """Connect the driver. Raises DeviceError if there is no such camera."""

    def timing_of(self, settings: Any, wanted: CameraSettings) -> CameraTiming:
        """The timing of the camera before it is connected. Raises ValueError for settings that the camera would not
        accept."""


CAMERAS: Registry[CameraDriver] = Registry("camera", {}, with_settings, reserved=("dcam", "simulated_orca"))
"""For each kind in a configuration, the driver."""


Roi = Annotated[
    tuple[
        Annotated[int, Setting(ge=0)],
        Annotated[int, Setting(ge=0)],
        Annotated[int, Setting(ge=1)],
        Annotated[int, Setting(ge=1)],
    ],
    Setting("row0, col0, rows, cols on the sensor, all multiples of 4"),
]


class _Orca(Section):
    """The keys that the real and the simulated ORCA-Quest share."""

    kind: str
    model: Literal["C15550-20UP", "C15550-22UP"] = setting(
        "C15550-20UP",
        "Model of the camera: C15550-20UP is the ORCA-Quest, C15550-22UP the ORCA-Quest 2. The readout ultra_quiet "
        "is five times as fast in the ORCA-Quest 2 as in the ORCA-Quest. Plans and simulations use the timing of "
        "this model.",
    )
    roi: Roi | None = setting(None, "null: the full sensor, 2304 x 4096.")
    binning: Literal[1, 2, 4] = 1
    readout: Literal["standard", "ultra_quiet", "photon_number"] = setting(
        "standard",
        "photon_number: pixel values are numbers of photoelectrons; this readout takes as long as ultra_quiet.",
    )
    trigger_polarity: Literal["positive", "negative"] = setting(
        "positive",
        "Edge of the trigger pulse that starts an exposure. A camera that was just switched on uses "
        "negative; the driver sets the value given here.",
    )

    def timing_of(self, wanted: CameraSettings) -> CameraTiming:
        """The timing that the camera will report. Raises ValueError for settings that the camera would not accept."""
        return orca_quest.timing(wanted, model=self.model)


class SimulatedOrca(_Orca):
    kind: Literal["simulated_orca"]


class DcamOrca(section_of("DcamOrcaKeys", _Orca, declared(DcamOptions))):  # type: ignore[misc]
    kind: Literal["dcam"]
    library: str | None = setting(None, "Path of the DCAM-API library; null: the installed library.")
    index: int = setting(0, "Number of the camera to use (counted from 0), if DCAM finds several cameras.", ge=0)
    link: Literal["usb3", "coaxpress"] = setting(
        "usb3", "USB3 transfers 17.7 full frames per second; CoaXPress transfers 120 full frames per second."
    )
    cool_s: float = setting(
        0.0,
        "Before a scan starts, it waits until the sensor is cold, at most for this time in s; 0: the scan does not "
        "wait.",
        ge=0,
        le=1e6,
    )
    usb_product: int | None = setting(
        None,
        "USB product id, for `check --connect`; null: any product of the vendor (who also makes other devices).",
        ge=0,
        le=0xFFFF,
    )
    usb_serial: str | None = setting(None, "USB serial number, for `check --connect`, if there are several cameras.")

    @property
    def options(self) -> DcamOptions:
        """The values of the keys as settings of the driver."""
        options: DcamOptions = read_from(self, DcamOptions)
        return options

    def timing_of(self, wanted: CameraSettings) -> CameraTiming:
        return orca_quest.timing(wanted, self.link, self.model)


class PluggedCamera(Section):
    """A camera of another package. Its keys are those that its settings declare."""

    kind: str
    roi: (
        tuple[
            Annotated[int, Setting(ge=0)],
            Annotated[int, Setting(ge=0)],
            Annotated[int, Setting(gt=0)],
            Annotated[int, Setting(gt=0)],
        ]
        | None
    ) = setting(None, "row0, col0, rows, cols on the sensor; null: the whole sensor.")
    binning: int = setting(1, gt=0)
    readout: str = "standard"

    def timing_of(self, wanted: CameraSettings) -> CameraTiming:
        """The timing that the camera will report. Raises ValueError for settings that the camera would not accept."""
        driver = CAMERAS[self.kind]
        return driver.timing_of(read_from(self, driver.Settings), wanted)

    def connect(self, clock: Clock) -> Camera:
        """Connect the driver of the camera; see `CameraDriver`."""
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
    """A device without settings: simulated, or manual (the operator is asked to act)."""

    kind: Literal["simulated", "manual"]


def _installed_sections(table: str) -> tuple[type[Section], ...]:
    """Sections of the families of devices, by the name of the table in their folders."""
    return tuple(in_folders("beamline.config.families", table).values())


if TYPE_CHECKING:
    ShutterConfig = Simple | StageOutputShutter | FoundShutter
    FilterConfig = NoFilter | NamedFilter | MotorFilter | FoundFilter
    MonochromatorConfig = NoMonochromator | SceneMonochromator | HandMonochromator | FoundMonochromator
    BeamMonitorConfig = NoBeamMonitor | BeamMonitorSection
else:
    ShutterConfig = Union[(Simple, StageOutputShutter, *_installed_sections("SHUTTERS"))]
    FilterConfig = Union[(NoFilter, NamedFilter, MotorFilter, *_installed_sections("FILTERS"))]
    MonochromatorConfig = Union[
        (NoMonochromator, SceneMonochromator, HandMonochromator, *_installed_sections("MONOCHROMATORS"))
    ]
    BeamMonitorConfig = Union[(NoBeamMonitor, *_installed_sections("BEAM_MONITORS"))]


def _simulated(device: Simple | StageMover | FilterConfig) -> bool:
    return device.stage.simulated if isinstance(device, MotorSection) else device.kind == "simulated"


class DeviceSection(Section):
    stage: Annotated[StageConfig, Field(discriminator="kind")]
    camera: Annotated[CameraConfig, Field(discriminator="kind")]
    shutter: Annotated[ShutterConfig, Field(discriminator="kind")]
    sample_mover: Annotated[Simple | StageMover, Field(discriminator="kind")]
    filter: Annotated[FilterConfig, Field(discriminator="kind")] = NoFilter()
    monochromator: Annotated[MonochromatorConfig, Field(discriminator="kind")] = NoMonochromator()
    beam_monitor: Annotated[BeamMonitorConfig, Field(discriminator="kind")] = NoBeamMonitor()

    @model_validator(mode="after")
    def _edges_agree(self) -> Self:
        camera, high = self.camera, self.stage.settings.active_high
        if isinstance(camera, SimulatedOrca) and (camera.trigger_polarity == "positive") is not high:
            right_polarity = "positive" if high else "negative"
            raise ValueError(
                f"stage.active_high {str(high).lower()} contradicts camera.trigger_polarity "
                f"{camera.trigger_polarity}: the simulated cable has no inverter, so every exposure would start at "
                f"the end of its pulse. Set trigger_polarity {right_polarity}"
            )
        return self

    @model_validator(mode="after")
    def _output_is_free(self) -> Self:
        taken, shutter = self.stage.settings.pulse_output, self.shutter
        if not isinstance(shutter, StageOutputShutter):
            return self
        if taken is None:
            with_outputs = [kind for kind, driver in STAGES.items() if driver.Settings.pulse_output is not None]
            kinds_with_outputs = " or ".join(with_outputs)
            raise ValueError(
                f"shutter.kind: a {self.stage.kind} stage has no digital output for a shutter; set shutter.kind to "
                f"manual, or use the output of another controller (stage.kind {kinds_with_outputs})"
            )
        if shutter.output == taken:
            raise ValueError(f"shutter.output {taken} carries the trigger pulses of the stage; choose another output")
        return self

    @model_validator(mode="after")
    def _port_is_free(self) -> Self:
        taken = {self.stage.port: "devices.stage"}
        for name, device in (("sample_mover", self.sample_mover), ("filter", self.filter)):
            if not isinstance(device, MotorSection) or device.stage.simulated:
                continue
            if (port := device.stage.port) in taken:
                other_device = taken[port]
                raise ValueError(
                    f"{name}.stage.port {port} is also used by {other_device}, and a port can be opened only once; "
                    f"the {name.replace('_', ' ')} needs a separate controller or record"
                )
            taken[port] = f"devices.{name}"
        return self

    @property
    def by_hand(self) -> frozenset[str]:
        """Names of the devices that the operator moves when the scan asks."""
        names = ("shutter", "sample_mover", "filter", "monochromator")
        return frozenset(name for name in names if getattr(self, name).kind == "manual")

    def simulated_or_not(self) -> dict[str, bool]:
        """Each device that can be simulated, and whether it is simulated."""
        stage, shutter = self.stage.simulated, self.shutter.kind
        always = {
            "stage": stage,
            "camera": self.camera.kind == "simulated_orca",
            "shutter": shutter == "simulated" or (shutter == "stage_output" and stage),
            "sample_mover": _simulated(self.sample_mover),
        }
        mono, monitor = self.monochromator, self.beam_monitor
        perhaps = {
            "filter": None if isinstance(self.filter, NoFilter) else _simulated(self.filter),
            "monochromator": None if isinstance(mono, NoMonochromator) else mono.kind == "simulated",
            "beam_monitor": None if monitor.counterpart is None else monitor.simulated,
        }
        return always | {name: is_so for name, is_so in perhaps.items() if is_so is not None}
