"""Configuration models: every key a configuration file may hold, its unit, its legal values and its default."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveFloat, PositiveInt, model_validator

from beamline.plan import Mode, Place


class Section(BaseModel):
    """A frozen group of keys. Unknown keys are refused, and so is `yes` where a number belongs."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    @model_validator(mode="before")
    @classmethod
    def _no_truth_for_numbers(cls, data: Any) -> Any:
        for name, field in cls.model_fields.items():
            if isinstance(data, dict) and isinstance(data.get(name), bool) and field.annotation is not bool:
                value = str(data[name]).lower()
                raise ValueError(f"{name} is {value} (YAML reads yes, no, on and off as true and false)")
        return data


class Sample(Section):
    name: Annotated[str, Field(pattern=r"^\w([\w.+-]*[\w+-])?$", max_length=80)]
    """letters, digits and _ . + - (it ends the run folder's name)"""
    description: str = ""


Views = Annotated[int, Field(gt=0, le=1_000_000)]


class FixedAngles(Section):
    """Equal steps from start_deg over span_deg; the end itself is excluded (180 views over 180 deg: 0 ... 179)."""

    scheme: Literal["fixed"]
    views: Views
    start_deg: FiniteFloat = 0.0
    span_deg: FiniteFloat = 180.0


class SectorAngles(Section):
    """Equal steps from first_deg to last_deg, both included (a limited-angle scan)."""

    scheme: Literal["sector"]
    views: Views
    first_deg: FiniteFloat
    last_deg: FiniteFloat


class RandomAngles(Section):
    """Uniformly random over span_deg, sorted; step scans only."""

    scheme: Literal["random"]
    views: Views
    start_deg: FiniteFloat = 0.0
    span_deg: FiniteFloat = 180.0
    seed: int = 0


class InterlacedAngles(Section):
    """The fixed angles taken in several passes, each pass in the gaps that the earlier ones left."""

    scheme: Literal["interlaced"]
    views: Views
    passes: PositiveInt
    start_deg: FiniteFloat = 0.0
    span_deg: FiniteFloat = 180.0


class GoldenAngles(Section):
    """Golden-ratio steps modulo span_deg: well spread after any number of views; step scans only."""

    scheme: Literal["golden"]
    views: Views
    start_deg: FiniteFloat = 0.0
    span_deg: FiniteFloat = 180.0


class FileAngles(Section):
    """Degrees from a text file, one a line, in the order of acquisition; # starts a comment."""

    scheme: Literal["file"]
    path: str
    """Relative to the configuration file."""


Angles = Annotated[
    FixedAngles | SectorAngles | RandomAngles | InterlacedAngles | GoldenAngles | FileAngles,
    Field(discriminator="scheme"),
]


class Fields(Section):
    """Darks or flats: how many at each place, and their own exposure (null: the scan's)."""

    count: Annotated[int, Field(ge=0, le=1_000_000)] = 10
    at: Place = Place.START
    exposure_s: PositiveFloat | None = None


class Scan(Section):
    mode: Literal[Mode.FLY, Mode.STEP] = Mode.FLY
    angles: Angles
    exposure_s: PositiveFloat
    period_s: PositiveFloat
    """Time between views: sets the speed of a fly scan, the least time per view of a step scan."""
    settle_s: Annotated[float, Field(ge=0)] = 0.1
    """Wait after each move of a step scan."""
    darks: Fields = Fields()
    flats: Fields = Fields()


class PM16CStageConfig(Section):
    """Tsuji PM16C-04XD pulse-motor controller on a serial port, a TCP port or simulated."""

    kind: Literal["pm16c"]
    port: Annotated[str, Field(min_length=1)]
    """A serial port (COM3, /dev/ttyUSB0), socket://host:7777, or sim://pm16c."""
    channel: Annotated[int, Field(ge=0, le=15)] = 0
    counts_per_turn: PositiveInt
    max_speed_deg_s: PositiveFloat
    acceleration_deg_s2: PositiveFloat
    low_deg: FiniteFloat = -5.0
    high_deg: FiniteFloat = 365.0

    @model_validator(mode="after")
    def _ordered(self) -> PM16CStageConfig:
        if not self.low_deg < self.high_deg:
            raise ValueError(f"low_deg {self.low_deg} must lie below high_deg {self.high_deg}")
        return self

    @property
    def simulated(self) -> bool:
        return self.port.lower().startswith("sim://")


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
    """What the real and the simulated ORCA-Quest have in common."""

    kind: str
    roi: Roi | None = None
    """null: the full sensor, 2304 x 4096."""
    binning: Literal[1, 2, 4] = 1
    readout: Literal["standard", "ultra_quiet"] = "standard"


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


class Simple(Section):
    """A device with nothing to set: simulated, or manual (the operator is asked to do it)."""

    kind: Literal["simulated", "manual"]


class DeviceSection(Section):
    stage: PM16CStageConfig
    camera: Annotated[SimulatedOrca | DcamOrca, Field(discriminator="kind")]
    shutter: Simple
    sample_mover: Simple


class Optics(Section):
    pixel_size_um: PositiveFloat
    """Of an unbinned pixel at the sample."""
    energy_kev: PositiveFloat | None = None
    distance_mm: Annotated[float, Field(ge=0)] | None = None
    """Sample to detector."""
    axis_col: FiniteFloat | None = None
    """Column of the rotation axis, 0 at the centre of the first column of the (binned) frame; null: unknown."""


class Storage(Section):
    folder: Annotated[str, Field(min_length=1)] = "runs"
    preview_bin: PositiveInt = 4
    flush_every: PositiveInt = 1


class Monitor(Section):
    on_alarm: Literal["log", "stop"] = "log"
    thresholds: dict[str, dict[str, FiniteFloat]] = Field(default_factory=dict)
    """Per check, the limits that differ from its defaults."""


class Recon(Section):
    live: bool = True
    method: Literal["r2", "fbp"] = "r2"
    seconds: PositiveFloat = 30.0
    """Time for the fit after the last view."""
    axis: Literal["auto"] | FiniteFloat = "auto"
    seed: int = 0


class Speed(Section):
    speed: PositiveFloat
    """Simulated seconds per real second."""


class Simulation(Section):
    """Only with simulated devices."""

    scene: str | dict[str, Any] = "scenes/battery.yaml"
    """A scene file (relative to the configuration file or to the installed configs), or the scene itself."""
    clock: Literal["real", "virtual"] | Speed = "real"
    seed: int = 0


class Config(Section):
    """A whole configuration file."""

    sample: Sample
    scan: Scan
    devices: DeviceSection
    optics: Optics
    storage: Storage = Storage()
    monitor: Monitor = Monitor()
    recon: Recon = Recon()
    simulation: Simulation | None = None

    @model_validator(mode="after")
    def _all_simulated_or_none(self) -> Config:
        devices = self.devices
        simulated = {
            "stage": devices.stage.simulated,
            "camera": devices.camera.kind == "simulated_orca",
            "shutter": devices.shutter.kind == "simulated",
            "sample_mover": devices.sample_mover.kind == "simulated",
        }
        if any(simulated.values()) and not all(simulated.values()):
            unreal = ", ".join(name for name, value in simulated.items() if value)
            real = ", ".join(name for name, value in simulated.items() if not value)
            raise ValueError(
                f"simulated devices cannot see real ones: {unreal} simulated, {real} real; make all simulated or none"
            )
        if any(simulated.values()) and self.simulation is None:
            raise ValueError("simulated devices need a simulation section; `simulation: {}` takes its defaults")
        if self.simulation is not None and not any(simulated.values()):
            raise ValueError("the simulation section belongs to simulated devices and every device is real; remove it")
        return self

    @property
    def simulated(self) -> bool:
        return self.devices.stage.simulated
