"""Configuration models: every key a configuration file may hold, its unit, its legal values and its default."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from beamline.config.beam import Kev, NoMonochromator
from beamline.config.devices import DeviceSection
from beamline.config.monitor import MonitorSection, ReferencesSection
from beamline.config.section import Section
from beamline.core.files import RUNS
from beamline.plan.plan import Mode, Place
from drivers.orca_quest import LightPath
from recon.base.choices import AUTO
from recon.methods import DEFAULT, names_of_one_volume, streams

if TYPE_CHECKING:
    MethodName = str
else:
    MethodName = Literal[(AUTO, *names_of_one_volume())]


class SampleSection(Section):
    name: Annotated[str, Field(pattern=r"^\w([\w.+-]*[\w+-])?$", max_length=80)] = Field(
        description="letters, digits and _ . + - (it ends the run folder's name)"
    )
    description: str = ""
    diameter_mm: Annotated[float, Field(gt=0, le=1e3)] | None = Field(
        default=None, description="Of the circle about the rotation axis that holds all of the sample; null: not known."
    )


Views = Annotated[int, Field(gt=0, le=1_000_000)]
Degrees = Annotated[float, Field(ge=-1e6, le=1e6)]


class _Span(Section):
    """The keys that most schemes share."""

    scheme: str
    views: Views
    start_deg: Degrees = 0.0
    span_deg: Degrees = 180.0


class FixedAngles(_Span):
    """Equal steps from start_deg over span_deg; the end itself is excluded (180 views over 180 deg: 0 ... 179)."""

    scheme: Literal["fixed"]


class SectorAngles(Section):
    """Equal steps from first_deg to last_deg, both included (a limited-angle scan)."""

    scheme: Literal["sector"]
    views: Views
    first_deg: Degrees
    last_deg: Degrees


class RandomAngles(_Span):
    """Uniformly random over span_deg, sorted; step scans only."""

    scheme: Literal["random"]
    seed: int = 0


class InterlacedAngles(_Span):
    """The fixed angles in several passes, each pass in the gaps of the earlier ones."""

    scheme: Literal["interlaced"]
    passes: Views


class GoldenAngles(_Span):
    """Golden-ratio steps modulo span_deg: well spread after any number of views; step scans only."""

    scheme: Literal["golden"]


class FileAngles(Section):
    """Degrees from a text file, one a line, in the order of acquisition; # starts a comment."""

    scheme: Literal["file"]
    path: str = Field(description="Relative to the configuration file.")


AnglesSection = Annotated[
    FixedAngles | SectorAngles | RandomAngles | InterlacedAngles | GoldenAngles | FileAngles,
    Field(discriminator="scheme"),
]


Seconds = Annotated[float, Field(gt=0, le=1e6)]
Column = Annotated[float, Field(ge=-1e7, le=1e7)]


class Fields(Section):
    """Darks or flats: how many at each place, and their own exposure (null: the scan's)."""

    count: Annotated[int, Field(ge=0, le=1_000_000)] = 10
    at: Place = Place.START
    exposure_s: Seconds | None = None


class WishSection(Section):
    """What ends a scan that decides, whichever comes first; null: that does not end it."""

    quality_db: Annotated[float, Field(gt=0, le=100)] | None = Field(
        default=None, description="dB of PSNR by which the volume may stay below that of the whole plan."
    )
    seconds: Seconds | None = Field(
        default=None, description="From the first frame to the last flats and darks, at most."
    )
    dose: Annotated[float, Field(gt=0, le=1)] | None = Field(
        default=None, description="Share of the plan's exposures with light on the sample, at most."
    )


class ScanSection(Section):
    mode: Literal[Mode.FLY, Mode.STEP] = Mode.FLY
    angles: AnglesSection
    exposure_s: Seconds
    period_s: Seconds = Field(
        description="Time between views: sets the speed of a fly scan, the least time per frame of a step scan."
    )
    frames_per_view: Annotated[int, Field(ge=1, le=1000)] = Field(
        default=1,
        description="Frames at each angle of a step scan, which `beamline recon` averages to a view; the file has "
        "them all.",
    )
    settle_s: Annotated[float, Field(ge=0, le=1e6)] = Field(
        default=0.1, description="Wait after each move of a step scan."
    )
    warm_up_s: Annotated[float, Field(ge=0, le=1e6)] = Field(
        default=0.0,
        description="Light on the scintillator before frames with light, each time the shutter opens; it glows "
        "brighter when warm.",
    )
    filter: str | None = Field(
        default=None,
        description="Name of one of the places of devices.filter, where it is before the first frame; null: as it "
        "stands.",
    )
    energy: Kev | None = Field(
        default=None, description="keV to which devices.monochromator goes before the first frame; null: as it stands."
    )
    energies: Annotated[tuple[Kev, ...], Field(min_length=2, max_length=1000)] | None = Field(
        default=None,
        description="keV of a series: a scan at each, one after the other; each begins a fraction of a step later "
        "in angle.",
    )
    wide_views: Annotated[int, Field(ge=0, le=100)] = Field(
        default=0,
        description="Angles at which a sample wider than the field is stepped across the beam after the views, "
        "until all was shown.",
    )
    without_watchdog: Literal["warn", "pause"] = Field(
        default="warn",
        description="The behaviour of a scan without a watchdog, or with one that ended and could not be replaced.",
    )
    decide: Literal["off", "ask", "do"] = Field(
        default="off",
        description="What follows each pass of views: the plan (off), what the operator answers (ask), or the best "
        "gain a second until the wish is met (do).",
    )
    wish: WishSection = WishSection(quality_db=1.0)
    wait_s: Annotated[float, Field(ge=0, le=3600)] = Field(
        default=30.0, description="Longest wait for a prediction after a pass, and again for the operator's answer."
    )
    pass_views: Annotated[int, Field(ge=0, le=1_000_000)] = Field(
        default=0, description="Views of a pass of a step scan; a fly scan has the passes of interlaced angles."
    )
    darks: Fields = Fields()
    flats: Fields = Fields()

    @model_validator(mode="before")
    @classmethod
    def _off_is_a_word(cls, data: Any) -> Any:
        """YAML reads a bare `off` as false."""
        return {**data, "decide": "off"} if isinstance(data, dict) and data.get("decide") is False else data


class OpticsSection(Section):
    pixel_size_um: Annotated[float, Field(gt=0, le=1e6)] = Field(description="Size of an unbinned pixel at the sample.")
    energy_kev: Annotated[float, Field(gt=0, le=1e6)] | None = None
    distance_mm: Annotated[float, Field(ge=0, le=1e7)] | None = Field(default=None, description="Sample to detector.")
    axis_col: Column | None = Field(
        default=None,
        description="Column of the rotation axis, 0 at the centre of the first column of the (binned) frame; "
        "null: unknown.",
    )
    light_path: LightPath | None = Field(
        default=None, description="From X-ray photons to photoelectrons, for `beamline tune`; null: not known."
    )


class StorageSection(Section):
    folder: Annotated[str, Field(min_length=1)] = RUNS
    preview_bin: Annotated[int, Field(gt=0, le=10_000)] = 4
    flush_every: Annotated[int, Field(gt=0, le=1_000_000)] = Field(
        default=16,
        description="Frames that are flushed together, at most, while others wait to be written; else each is "
        "flushed at once.",
    )


class ReconSection(Section):
    live: bool = Field(
        default=True,
        description="A volume while the scan runs; by a method that needs the whole scan, when it is complete.",
    )
    method: MethodName = Field(
        default=DEFAULT,
        description="r2 grows while the scan runs; the others need the whole scan. auto: as of `beamline recon`.",
    )
    seconds: Seconds = Field(
        default=1800.0,
        description="Most time after the last view: the volume is made as of a finished scan, and takes longer on "
        "a busy machine.",
    )
    axis: Literal["auto"] | Column = "auto"
    seed: int = 0


class Speed(Section):
    speed: Annotated[float, Field(gt=0, le=1e6)] = Field(description="Simulated seconds per real second.")


class SimulationSection(Section):
    """Settings of simulated devices and of rehearsals; a real instrument ignores them."""

    scene: str | dict[str, Any] = Field(
        default="scenes/battery.yaml",
        description="A scene file (relative to the configuration file or to the installed configs), or the scene "
        "itself.",
    )
    clock: Literal["real", "virtual"] | Speed = "real"
    seed: int = Field(0, ge=0, lt=2**63)


class Config(Section):
    """A whole configuration file."""

    sample: SampleSection
    scan: ScanSection
    devices: DeviceSection
    optics: OpticsSection
    storage: StorageSection = StorageSection()
    monitor: MonitorSection = MonitorSection()
    references: ReferencesSection = ReferencesSection()
    recon: ReconSection = ReconSection()
    simulation: SimulationSection | None = None

    @model_validator(mode="after")
    def _all_simulated_or_none(self) -> Self:
        simulated = self.devices.simulated_or_not()
        if any(simulated.values()) and not all(simulated.values()):
            unreal = ", ".join(name for name, value in simulated.items() if value)
            real = ", ".join(name for name, value in simulated.items() if not value)
            few_simulated = 2 * sum(simulated.values()) <= len(simulated)
            odd = next(name for name, value in simulated.items() if value is few_simulated)
            raise ValueError(
                f"devices.{odd}: simulated and real devices cannot be mixed: {unreal} simulated, {real} real. Make all "
                "simulated or none. `beamline scan CONFIG --rehearse` runs a real configuration with simulated devices"
            )
        if any(simulated.values()) and self.simulation is None:
            raise ValueError(
                "devices.camera: simulated devices need a simulation section; `simulation: {}` takes its defaults"
            )
        return self

    @model_validator(mode="after")
    def _filter_is_there(self) -> Self:
        named, there = self.scan.filter, list(self.devices.filter.places)
        if named is not None and named not in there:
            legal = f"devices.filter has {', '.join(there)}" if there else "devices.filter has none"
            raise ValueError(f"scan.filter {named!r} is not one of the filter's places; {legal}")
        return self

    @model_validator(mode="after")
    def _several_frames_are_of_a_step_scan(self) -> Self:
        n = self.scan.frames_per_view
        if n > 1 and self.scan.mode is Mode.FLY:
            raise ValueError(
                f"scan.frames_per_view {n}: each frame of a fly scan has its own angle; set scan.mode to step, or "
                "plan more views, which collect as much light"
            )
        if n > 1 and self.monitor.retake:
            raise ValueError(
                f"scan.frames_per_view {n}: a frame with an alarm is left out of its view's mean, so none is taken "
                "again; set monitor.retake to false"
            )
        return self

    @model_validator(mode="after")
    def _energy_can_be_set(self) -> Self:
        one, several = self.scan.energy, self.scan.energies
        if one is not None and several is not None:
            raise ValueError("scan.energy and scan.energies exclude each other; give one of them")
        texts = [f"{energy:.7g}" for energy in several or ()]  # as the names of run folders
        if twice := [text for text in texts if texts.count(text) > 1]:
            raise ValueError(f"scan.energies lists {twice[0]} keV twice, to seven digits; give each energy once")
        return self

    @model_validator(mode="after")
    def _decisions_have_a_volume_and_passes(self) -> Self:
        scan, recon, angles = self.scan, self.recon, self.scan.angles
        interlaced = isinstance(angles, InterlacedAngles) and angles.passes > 1
        needs = {
            "one scan at a time; set scan.energies to null": scan.energies is None,
            "a live volume; set recon.live to true": recon.live,
            "a volume that grows with the views; set recon.method to r2": streams(recon.method),
            "passes; set scan.angles to {scheme: interlaced, passes: 8, ...}, or scan.pass_views of a step scan, such "
            "as 60": 0 < scan.pass_views < getattr(angles, "views", math.inf) if scan.mode is Mode.STEP else interlaced,
        }
        if scan.decide != "off" and not all(needs.values()):
            lacking = next(need for need, met in needs.items() if not met)
            raise ValueError(f"scan.decide {scan.decide} needs {lacking}; off takes the plan as it is")
        return self

    @model_validator(mode="after")
    def _monochromator_reaches_the_energies(self) -> Self:
        device, name = self.devices.monochromator, "scan.energies" if self.scan.energies else "scan.energy"
        energies = self.scan.energies or ([] if self.scan.energy is None else [self.scan.energy])
        if energies and isinstance(device, NoMonochromator):
            raise ValueError(
                f"{name} needs a monochromator, and devices.monochromator.kind is none; name one, or set {name} to null"
            )
        low, high = getattr(device, "range_kev", None) or (0.0, math.inf)
        if beyond := [energy for energy in energies if not low <= energy <= high]:
            raise ValueError(
                f"{name}: {beyond[0]:.7g} keV is not within devices.monochromator.range_kev {low:g} ... {high:g}"
            )
        return self

    @property
    def simulated(self) -> bool:
        return self.devices.stage.simulated
