"""Configuration of `beamline ride`: the sources of the frames, of their angles and of their kinds."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self, cast

from pydantic import Field, model_validator

from beamline.config.beam import NoBeamMonitor
from beamline.config.models import (
    Config,
    Degrees,
    Fields,
    OpticsSection,
    ReconSection,
    SampleSection,
    Seconds,
    StorageSection,
    TargetSection,
    Views,
)
from beamline.config.monitor import MonitorSection, ReferencesSection
from beamline.config.section import Section, section_of
from recon.base.setting import Setting, setting
from splatline_areadetector.stream import Queues, image_problem
from splatline_areadetector.variables import url_problem

KINDS = "HDF5FrameLocation"
"""NDAttribute with the kind of a frame: tomoscan sets it, and the file plugin at APS sorts frames by it."""


Prefix = Annotated[str, Setting("pva:// or ca:// and a prefix of process variables", problem=url_problem)]


def _from(kind: str) -> Any:
    """A section of the configuration whose key `from` has this value."""
    return section_of(f"{kind.title()}Base", Section, {"from": (Literal[kind], ...)})


class TomoscanAngles(_from("tomoscan")):  # type: ignore[misc]
    """A scan run by tomoscan: its process variables give start, step, numbers of frames and the kind of each frame."""

    prefix: Prefix


class PlanAngles(_from("plan")):  # type: ignore[misc]
    """A scan with equal steps, counted from the first projection."""

    views: Views
    start_deg: Degrees = 0.0
    step_deg: Degrees


class AttributeAngles(_from("attribute")):  # type: ignore[misc]
    """A step scan: each frame has an attribute with its angle, which is the position of the stage at rest."""

    views: Views
    name: str = setting("SampleRotary", "Name of the NDAttribute, in degrees.", min_length=1)


class PandaAngles(_from("panda")):  # type: ignore[misc]
    """A fly scan with a PandABox: angles come from its file, read while it is written. Row n belongs to trigger n."""

    views: Views
    file: str = setting(doc="The HDF5 file of the PandABox, written in SWMR mode.", min_length=1)
    dataset: str = setting("/INENC1.VAL.Value", "The position captured at each trigger.", min_length=1)
    deg_per_unit: float = setting(1.0, "Degrees for each unit of this dataset.", ge=-1e6, le=1e6)
    offset_deg: float = setting(
        0.0, "Degrees that are added to each position.", ge=-1e9, le=1e9
    )  # of absolute encoders


Angles = Annotated[TomoscanAngles | PlanAngles | AttributeAngles | PandaAngles, Field(discriminator="from")]


class RideSection(Section):
    """The scan of the other program: the sources of its frames and angles."""

    image: Annotated[str, Setting(problem=image_problem)] = setting(doc="Process variable of the image, over PVAccess.")
    angles: Angles
    kinds: str | None = setting(
        None,
        f"NDAttribute with the kind of a frame: dark, flat or projection ({KINDS}). null: the kind comes from the "
        f"status of tomoscan or, without tomoscan, from the order of darks, projections and flats.",
        min_length=1,
    )
    darks: Fields = setting(
        Fields(count=0),
        "Number of darks of the scan, if tomoscan does not give it. Without `kinds`, darks are recognised by their "
        "order.",
    )
    flats: Fields = Fields(count=0)
    camera: Prefix | None = setting(
        None,
        (
            "Prefix of the camera's process variables, such as ca://2bmSP2:cam1:; null: the camera's variables are "
            "not read."
        ),
    )
    source: str | None = setting(
        None, "Port of areaDetector whose frames are stored unchanged, such as ROI1; null: the camera's own frames.",
        min_length=1,
    )  # fmt: skip
    first_id: int | None = setting(
        None,
        "uniqueId of the first projection of the scan; null: the uniqueId of the first projection that arrives.",
        ge=0,
    )
    exposure_s: Seconds | None = setting(
        None,
        "Exposure time; null: the attribute AcquireTime of each frame, or, if there is none, the value of "
        "tomoscan or of the camera.",
    )
    period_s: Seconds | None = setting(
        None, "Approximate time between frames, for the size of the queue; null: 100 frames a second."
    )
    bits: int | None = setting(
        None, "Bits of a pixel, for the saturation value; null: all bits of the pixel type.", ge=1, le=16
    )
    queue_s: float = setting(1.0, "Frames that the server buffers for this program, in seconds.", gt=0, le=60)
    queue_mb: float = setting(
        512.0, "Largest memory of the IOC for frames that the server buffers for this program, in MB.", gt=0, le=65_536
    )
    ring_mb: float = setting(
        2048.0, "Largest memory of this program for frames that wait for the disk, in MB.", gt=0, le=1e6
    )
    silence_s: Seconds = setting(
        60.0, "If no frame comes for this time, a message gives the reason, as far as the IOC shows it."
    )

    @property
    def queues(self) -> Queues:
        return Queues(self.queue_s, self.queue_mb, self.ring_mb)


class _Devices(Section):
    """The devices of a scan configuration: none, because the other program controls them."""

    beam_monitor: NoBeamMonitor = NoBeamMonitor()


class _Scan(Section):
    """The plan settings of a scan configuration, switched off: the other program has the plan."""

    decide: Literal["off"] = "off"
    target: TargetSection = TargetSection()
    wait_s: float = 0.0


class RideConfig(Section):
    """A whole configuration file of `beamline ride`. All sections except `ride` are those of a scan configuration."""

    sample: SampleSection
    ride: RideSection
    optics: OpticsSection
    storage: StorageSection = StorageSection()
    monitor: MonitorSection = MonitorSection()
    references: ReferencesSection = ReferencesSection()
    recon: ReconSection = ReconSection()

    @property
    def as_scan(self) -> Config:
        """This configuration as one for a scan, for functions that take the configuration of a scan. The sections have
        the same names and types."""
        return cast(Config, self)

    @property
    def devices(self) -> _Devices:
        return _Devices()

    @property
    def scan(self) -> _Scan:
        return _Scan()

    @property
    def simulation(self) -> None:
        return None

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        angles = self.ride.angles
        if isinstance(angles, PlanAngles) and angles.views > 1 and not math.fabs(angles.step_deg) > 0:
            raise ValueError(
                f"ride.angles.step_deg is {angles.step_deg:g}: {angles.views} projections need a step that is not 0"
            )
        if self.monitor.retake:
            raise ValueError(
                "monitor.retake: `beamline ride` cannot take projections again, because another program runs the scan"
            )
        if (missing := self.recon.missing_reference) is not None:
            raise ValueError(missing)
        return self


EXAMPLE = """\
# `beamline ride` with this file records a scan that another program runs (docs/areadetector.md). It writes no process
# variable. `beamline ride FILE --check` shows the settings of the IOC, and whether the frames of 2 s are complete.
# Units are in the names of the keys: s, deg, mm, um, keV. null means "not known" or "use the default".

sample: {name: tooth, description: "", diameter_mm: null}

ride:
  image: "pva://2bmSP2:Pva1:Image"      # PvName of NDPluginPva or NDPluginPvxs
  # from: tomoscan   prefix                             process variables of tomoscan: start, step, kinds of frames
  #       plan       views, start_deg, step_deg         equal steps from the first projection
  #       attribute  views, name                        step scans: an NDAttribute in degrees
  #       panda      views, file, dataset, deg_per_unit, offset_deg   the HDF5 file of a PandABox (SWMR)
  angles: {from: tomoscan, prefix: "ca://2bmb:TomoScan:"}
  kinds: null                           # NDAttribute with the kind of a frame (HDF5FrameLocation); null: from
                                        # tomoscan's status, or from the order of the frames (for darks and flats in
                                        # files, use --darks and --flats)
  camera: "ca://2bmSP2:cam1:"           # to read the camera's port, exposure and counters; null: do not read them
  source: null                          # port whose frames are stored unchanged, such as ROI1; null: camera's frames
  first_id: null                        # uniqueId of the first projection; null: of the first one that arrives
  exposure_s: null                      # null: from the attribute AcquireTime, from tomoscan or from the camera
  period_s: null                        # approximate time between frames, for the queue; null: 100 frames a second
  bits: null                            # bits of a pixel, for the saturation value; null: all bits of the pixel type
  queue_s: 1                            # seconds of frames that the server buffers for this program
  queue_mb: 512                         # largest memory of the IOC for this buffer
  ring_mb: 2048                         # largest memory of this program for frames that wait for the disk
  silence_s: 60                         # if no frame comes for this time, a message gives the reason

optics:
  pixel_size_um: 0.65                   # size of an unbinned pixel at the sample
  energy_kev: null
  distance_mm: null
  axis_col: null                        # column of the rotation axis; null: searched in the data

storage: {folder: runs}
recon: {live: true, method: r2, axis: auto}
"""
