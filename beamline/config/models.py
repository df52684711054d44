"""Configuration models: they declare every key of a configuration file, with its unit, allowed values and default."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
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
from recon.base.setting import Setting, setting
from recon.methods import DEFAULT, WITH_REFERENCE, names_of_one_volume, streams

if TYPE_CHECKING:
    MethodName = str
else:
    MethodName = Literal[(AUTO, *names_of_one_volume())]


class SampleSection(Section):
    name: str = setting(
        doc="letters, digits and _ . + - (the name of the run's folder ends with this name)",
        pattern=r"^\w([\w.+-]*[\w+-])?$",
        max_length=80,
    )
    description: str = ""
    diameter_mm: float | None = setting(
        None,
        "Diameter in mm of the smallest circle about the rotation axis that contains the whole sample; null: not "
        "known.",
        gt=0,
        le=1e3,
    )


Views = Annotated[int, Setting(gt=0, le=1_000_000)]
Degrees = Annotated[float, Setting(ge=-1e6, le=1e6)]


class _Span(Section):
    """The keys that most schemes of angles share."""

    scheme: str
    views: Views
    start_deg: Degrees = 0.0
    span_deg: Degrees = 180.0


class FixedAngles(_Span):
    """Equal steps from start_deg over span_deg, without the end itself (180 projections over 180 deg: 0 ... 179)."""

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
    """The angles of `fixed`, in several passes. Each pass fills gaps between the angles of earlier passes."""

    scheme: Literal["interlaced"]
    passes: Views


class GoldenAngles(_Span):
    """Golden-ratio steps modulo span_deg. The angles are well spread after any number of projections; step scans
    only."""

    scheme: Literal["golden"]


class FileAngles(Section):
    """Angles in degrees from a text file, one per line, in the order of acquisition; # starts a comment."""

    scheme: Literal["file"]
    path: str = setting(doc="Relative to the configuration file.")


AnglesSection = Annotated[
    FixedAngles | SectorAngles | RandomAngles | InterlacedAngles | GoldenAngles | FileAngles,
    Field(discriminator="scheme"),
]


Seconds = Annotated[float, Setting(gt=0, le=1e6)]
Column = Annotated[float, Setting(ge=-1e7, le=1e7)]


class Fields(Section):
    """Darks or flats: the number at each time, and their exposure (null: the exposure of the scan)."""

    count: int = setting(10, ge=0, le=1_000_000)
    at: Place = Place.START
    exposure_s: Seconds | None = None


class TargetSection(Section):
    """Targets that end a scan that makes decisions. The scan ends when the first target is reached; null: no such
    target."""

    quality_db: float | None = setting(
        None,
        (
            "Accepted loss in dB: the PSNR of the volume may be lower by this value than the PSNR that the whole "
            "plan would give."
        ),
        gt=0,
        le=100,
    )
    seconds: Seconds | None = setting(None, "Longest time in s from the first frame to the last flats and darks.")
    dose: float | None = setting(
        None,
        "Largest dose of the scan (exposures with beam on the sample), as a fraction of the dose of the whole plan.",
        gt=0,
        le=1,
    )


class StatesSection(Section):
    """A series of states of a sample that changes: one scan of each state."""

    count: int = setting(doc="Number of states.", ge=2, le=1000)
    every_s: Seconds | None = setting(
        None,
        "Time in s from the start of one state to the start of the next state. A state that takes longer delays the "
        "next state. null: each state after the first waits for `beamline resume`, from a terminal or a script.",
    )
    references: Literal["first", "each"] = setting(
        "first",
        "Darks and flats of the states after the first one. first: the darks and flats of the first state are "
        "copied into the files of the other states. each: the scan of each state takes its own darks and flats.",
    )


class ScanSection(Section):
    mode: Literal[Mode.FLY, Mode.STEP] = Mode.FLY
    angles: AnglesSection
    exposure_s: Seconds
    period_s: Seconds = setting(
        doc="Time in s between projections. This time sets the speed of a fly scan, and the shortest time per frame "
        "of a step scan."
    )
    frames_per_view: int = setting(
        1,
        "Frames at each angle of a step scan. `beamline recon` averages them to one projection; the file "
        "contains all of them.",
        ge=1,
        le=1000,
    )
    settle_s: float = setting(0.1, "Settling time in s after each move of a step scan.", ge=0, le=1e6)
    warm_up_s: float = setting(
        0.0,
        "Time in s for which the scintillator is exposed to the beam before frames are taken, each time the shutter "
        "opens. (A warm scintillator is brighter.)",
        ge=0,
        le=1e6,
    )
    filter: str | None = setting(
        None,
        "Name of one of the places of devices.filter. The filter moves there before the first frame; null: the "
        "filter stays where it is.",
    )
    energy: Kev | None = setting(
        None,
        "Photon energy in keV to which devices.monochromator moves before the first frame; null: the monochromator "
        "stays where it is.",
    )
    energies: tuple[Kev, ...] | None = setting(
        None,
        "Energies in keV of a series: one scan at each energy, one after the other. Each scan starts at a larger "
        "angle than the scan before, by a fraction of an angular step.",
        min_length=2,
        max_length=1000,
    )
    states: StatesSection | None = setting(
        None,
        "A series of states of a sample that changes: one scan of each state, all in one folder. Each scan starts "
        "at a larger angle than the scan before, by a fraction of an angular step. null: one scan.",
    )
    state: int | None = setting(
        None, "Number of this scan in a series of states, counted from 1. The program sets this number.", ge=1, le=1000
    )
    offset_views: int = setting(
        0,
        "For a sample wider than the field of view: number of angles at which the stage steps the sample across the "
        "beam, after the other projections, so that frames cover the whole width of the sample. 0: the sample is "
        "not stepped.",
        ge=0,
        le=100,
    )
    on_watchdog_loss: Literal["warn", "pause"] = setting(
        "warn",
        "What a scan does if the watchdog cannot be started, or if the watchdog has ended and cannot be replaced.",
    )
    decide: Literal["off", "ask", "do"] = setting(
        "off",
        "What the scan does after each pass of projections. off: it continues the plan. ask: it does what the "
        "operator decides. do: it measures what improves the volume most per second, until the target is reached.",
    )
    target: TargetSection = TargetSection(quality_db=1.0)
    wait_s: float = setting(
        30.0,
        "Longest time in s that the scan waits for a prediction after a pass, and again for the decision of the "
        "operator.",
        ge=0,
        le=3600,
    )
    pass_views: int = setting(
        0,
        "Projections per pass of a step scan. In a fly scan, the passes of the interlaced angles are used instead.",
        ge=0,
        le=1_000_000,
    )
    darks: Fields = Fields()
    flats: Fields = Fields()

    @model_validator(mode="before")
    @classmethod
    def _off_is_a_word(cls, data: Any) -> Any:
        """YAML reads `off` without quotes as false."""
        return {**data, "decide": "off"} if isinstance(data, dict) and data.get("decide") is False else data


class OpticsSection(Section):
    pixel_size_um: float = setting(doc="Size in µm of an unbinned pixel at the sample.", gt=0, le=1e6)
    energy_kev: float | None = setting(None, gt=0, le=1e6)
    distance_mm: float | None = setting(None, "Distance from sample to detector.", ge=0, le=1e7)
    axis_col: Column | None = setting(
        None, "Column of the rotation axis, 0 at the centre of the first column of the (binned) frame; null: unknown."
    )
    dose_rate_gy_s: float | None = setting(
        None,
        "Dose in Gy that the sample absorbs per second in the open beam. The plan of a scan then states its dose. "
        "null: not known.",
        gt=0,
        le=1e12,
    )
    light_path: LightPath | None = setting(
        None,
        "Optics between sample and sensor, from which `beamline tune` computes photoelectrons per X-ray "
        "photon; null: not known.",
    )


class StorageSection(Section):
    folder: str = setting(RUNS, min_length=1)
    preview_bin: int = setting(4, gt=0, le=10_000)
    flush_every: int = setting(
        16,
        "Largest number of frames that are flushed to the file together if frames wait to be written. If no frame "
        "waits, each frame is flushed immediately.",
        gt=0,
        le=1_000_000,
    )


class ReconSection(Section):
    live: bool = setting(
        True,
        (
            "Reconstruct a volume during the scan. If the method needs the whole scan, the volume is reconstructed "
            "after the scan."
        ),
    )
    method: MethodName = setting(
        DEFAULT,
        "r2 makes a volume that grows during the scan; all other methods need the whole scan. auto: the program "
        "chooses the method after the scan, as `beamline recon` does.",
    )
    seconds: Seconds = setting(
        1800.0,
        "Time limit in s for the fit after the last projection. null: no time limit; the fit takes as many steps as "
        "for a finished scan, and needs more time on a busy computer.",
    )
    reference: str | None = setting(
        None,
        "File with a volume from an earlier, careful scan of the same sample, or that scan itself. The path is "
        "relative to the configuration file. After the scan, the volume is then made with this reference, and "
        "`method` is ignored. null: no "
        "reference.",
        min_length=1,
    )
    axis: Literal["auto"] | Column = "auto"
    seed: int = 0

    @property
    def chosen_method(self) -> str:
        """The method of the volume: `method`, or the one that uses the reference if there is one."""
        return self.method if self.reference is None or WITH_REFERENCE is None else WITH_REFERENCE

    @property
    def missing_reference(self) -> str | None:
        """The error if there is no file with the name of the reference."""
        if self.reference is None or Path(self.reference).exists():
            return None
        return f"recon.reference: there is no file {self.reference}; expected a volume of the same sample, or its scan"


class Speed(Section):
    speed: float = setting(doc="Simulated seconds per real second.", gt=0, le=1e6)


class SimulationSection(Section):
    """Settings of simulated devices and of rehearsals. A real instrument ignores them."""

    scene: str | dict[str, Any] = setting(
        "scenes/battery.yaml",
        "A scene file (relative to the configuration file or to the installed configs), or the scene itself.",
    )
    clock: Literal["real", "virtual"] | Speed = "real"
    seed: int = setting(0, ge=0, lt=2**63)


def _are(names: list[str]) -> str:
    return f"{', '.join(names)} {'is' if len(names) == 1 else 'are'}"


class Config(Section):
    """The content of a whole configuration file."""

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
            unreal = _are([name for name, value in simulated.items() if value])
            real = _are([name for name, value in simulated.items() if not value])
            few_simulated = 2 * sum(simulated.values()) <= len(simulated)
            odd_one = next(name for name, value in simulated.items() if value is few_simulated)
            raise ValueError(
                f"devices.{odd_one}: simulated and real devices cannot be mixed, but {unreal} simulated, and {real} "
                "real. Make all devices real or all devices simulated. `beamline scan CONFIG --rehearse` runs a "
                "configuration for real devices with simulated devices"
            )
        if any(simulated.values()) and self.simulation is None:
            raise ValueError(
                "devices.camera: simulated devices need a simulation section; `simulation: {}` uses its defaults"
            )
        return self

    @model_validator(mode="after")
    def _filter_is_there(self) -> Self:
        named, known_names = self.scan.filter, list(self.devices.filter.places)
        if named is not None and named not in known_names:
            legal = (
                f"the places of devices.filter are {', '.join(known_names)}"
                if known_names
                else "devices.filter has no places"
            )
            raise ValueError(f"scan.filter {named!r} is not one of the filter's places; {legal}")
        return self

    @model_validator(mode="after")
    def _several_frames_are_of_a_step_scan(self) -> Self:
        n = self.scan.frames_per_view
        if n > 1 and self.scan.mode is Mode.FLY:
            raise ValueError(
                f"scan.frames_per_view {n}: a fly scan cannot take several frames at one angle, because the stage does "
                "not stop. Set scan.mode to step, or frames_per_view to 1 and plan more projections: the scan then "
                "collects the same number of photons"
            )
        if n > 1 and self.monitor.retake:
            raise ValueError(
                f"scan.frames_per_view {n}: set monitor.retake to false. If a projection is the mean of several "
                "frames, a frame with an alarm is left out of the mean and is not taken again"
            )
        return self

    @model_validator(mode="after")
    def _energy_can_be_set(self) -> Self:
        energy, several = self.scan.energy, self.scan.energies
        if energy is not None and several is not None:
            raise ValueError("scan.energy and scan.energies exclude each other; give only one of the two keys")
        if several is not None and self.scan.states is not None:
            raise ValueError("scan.energies and scan.states exclude each other; give only one of the two keys")
        if self.scan.state is not None and self.scan.state > (self.scan.states.count if self.scan.states else 0):
            raise ValueError(
                f"scan.state {self.scan.state} is larger than the number of states in scan.states, or there is no "
                "scan.states; leave out scan.state, because the program sets this number in a series of states"
            )
        if self.scan.states is not None and self.scan.states.references == "first" and self.scan.darks.at is Place.END:
            raise ValueError(
                "scan.states.references first needs darks before the projections; set scan.darks.at to start or both"
            )
        texts = [f"{energy:.7g}" for energy in several or ()]  # as the names of run folders
        if twice := [text for text in texts if texts.count(text) > 1]:
            repeated = twice[0]
            raise ValueError(
                f"scan.energies lists {repeated} keV twice (rounded to seven digits); give each energy once"
            )
        return self

    @model_validator(mode="after")
    def _decisions_have_a_volume_and_passes(self) -> Self:
        scan, recon, angles = self.scan, self.recon, self.scan.angles
        interlaced = isinstance(angles, InterlacedAngles) and angles.passes > 1
        needs = {
            "a single scan, but scan.energies makes a series; set scan.energies to null": scan.energies is None,
            "a single scan, but scan.states makes a series; set scan.states to null": scan.states is None,
            "a live volume; set recon.live to true": recon.live,
            "a volume that grows during the scan, not one with a reference; set recon.reference to null": (
                recon.reference is None
            ),
            "a volume that grows during the scan, which only r2 makes; set recon.method to r2": streams(recon.method),
            "a scan in several passes; set scan.angles to {scheme: interlaced, passes: 8, ...}, or in a step scan "
            "set scan.pass_views (for example 60)": 0 < scan.pass_views < getattr(angles, "views", math.inf)
            if scan.mode is Mode.STEP
            else interlaced,
        }
        if scan.decide != "off" and not all(needs.values()):
            lacking = next(need for need, met in needs.items() if not met)
            raise ValueError(
                f"scan.decide {scan.decide} needs {lacking}; or set scan.decide to off, so that the "
                "scan follows its plan"
            )
        return self

    @model_validator(mode="after")
    def _monochromator_reaches_the_energies(self) -> Self:
        device, name = self.devices.monochromator, "scan.energies" if self.scan.energies else "scan.energy"
        energies = self.scan.energies or ([] if self.scan.energy is None else [self.scan.energy])
        if energies and isinstance(device, NoMonochromator):
            raise ValueError(
                f"{name} sets an energy, but no monochromator is configured (devices.monochromator.kind: none). Set "
                f"devices.monochromator.kind to the type of your monochromator, or set {name} to null"
            )
        low, high = getattr(device, "range_kev", None) or (0.0, math.inf)
        if out_of_reach := [energy for energy in energies if not low <= energy <= high]:
            bad_energy = out_of_reach[0]
            raise ValueError(
                f"{name}: {bad_energy:.7g} keV is not within devices.monochromator.range_kev {low:g} ... {high:g}"
            )
        return self

    @property
    def series(self) -> Sequence[float]:
        """The energies (keV), or the numbers of the states, of a series of scans; empty: a single scan."""
        if self.scan.states is not None and self.scan.state is None:
            return range(1, self.scan.states.count + 1)
        return self.scan.energies or ()

    @property
    def copies_references(self) -> bool:
        """Whether the scan copies its darks and flats from the first state of its series."""
        states = self.scan.states
        return states is not None and states.references == "first" and (self.scan.state or 1) > 1

    @property
    def simulated(self) -> bool:
        return self.devices.stage.simulated
