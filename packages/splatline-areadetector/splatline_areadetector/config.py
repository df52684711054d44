"""Configuration of `beamline ride`: where the frames come from, and what gives each its angle and kind."""

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
"""The attribute by which the file plugin of APS sorts frames: tomoscan sets it."""


Prefix = Annotated[str, Setting("pva:// or ca:// and a prefix of process variables", problem=url_problem)]


def _from(kind: str) -> Any:
    """A section whose key `from` is this word."""
    return section_of(f"{kind.title()}Base", Section, {"from": (Literal[kind], ...)})


class TomoscanAngles(_from("tomoscan")):  # type: ignore[misc]
    """Of a scan by tomoscan: start, step, counts and the kind of each frame by its process variables."""

    prefix: Prefix


class PlanAngles(_from("plan")):  # type: ignore[misc]
    """Equal steps from the first projection."""

    views: Views
    start_deg: Degrees = 0.0
    step_deg: Degrees


class AttributeAngles(_from("attribute")):  # type: ignore[misc]
    """Of a step scan: an attribute of each frame, the position of the stage while it stands."""

    views: Views
    name: str = setting("SampleRotary", "Name of the NDAttribute, in degrees.", min_length=1)


class PandaAngles(_from("panda")):  # type: ignore[misc]
    """Of a fly scan by a PandABox: its file, followed while it is written; row n is trigger n."""

    views: Views
    file: str = setting(doc="The HDF5 file of the PandABox, written in SWMR mode.", min_length=1)
    dataset: str = setting("/INENC1.VAL.Value", "The position captured at each trigger.", min_length=1)
    deg_per_unit: float = setting(1.0, "Degrees of a unit of it.", ge=-1e6, le=1e6)
    offset_deg: float = setting(0.0, "Degrees that are added to each.", ge=-1e9, le=1e9)  # of an absolute encoder


Angles = Annotated[TomoscanAngles | PlanAngles | AttributeAngles | PandaAngles, Field(discriminator="from")]


class RideSection(Section):
    """The scan that is ridden."""

    image: Annotated[str, Setting(problem=image_problem)] = setting(doc="The image over PVAccess.")
    angles: Angles
    kinds: str | None = setting(
        None,
        f"NDAttribute that tells darks, flats and projections ({KINDS}); null: tomoscan's status, or all are "
        "projections.",
        min_length=1,
    )
    darks: Fields = setting(Fields(count=0), "Expected beside the views where tomoscan does not tell; without kinds by "
                            "their order.")  # fmt: skip
    flats: Fields = Fields(count=0)
    camera: Prefix | None = setting(None, "Of the camera's variables, such as ca://2bmSP2:cam1:; null: not asked.")
    source: str | None = setting(
        None, "Port of areaDetector from which frames are taken as they are, such as ROI1; null: the camera's.",
        min_length=1,
    )  # fmt: skip
    first_id: int | None = setting(
        None, "uniqueId of the first projection; null: that of the first one that comes.", ge=0
    )
    exposure_s: Seconds | None = setting(
        None, "null: the attribute AcquireTime of each frame, else what tomoscan or the camera says."
    )
    period_s: Seconds | None = setting(None, "Between frames, about, for the queue; null: 100 a second at most.")
    bits: int | None = setting(None, "Of a count, for saturation; null: those of the pixels' type.", ge=1, le=16)
    queue_s: float = setting(1.0, "Frames that the server holds for us, in seconds.", gt=0, le=60)
    queue_mb: float = setting(512.0, "The same in MB of the IOC's memory, at most.", gt=0, le=65_536)
    ring_mb: float = setting(2048.0, "Frames that wait in our memory for the disk, at most.", gt=0, le=1e6)
    silence_s: Seconds = setting(60.0, "Without a frame, after which it is said why, as far as the IOC tells.")

    @property
    def queues(self) -> Queues:
        return Queues(self.queue_s, self.queue_mb, self.ring_mb)


class _Devices(Section):
    """No device is ours."""

    beam_monitor: NoBeamMonitor = NoBeamMonitor()


class _Scan(Section):
    """What an own scan asks of its plan, and a ridden one does not."""

    decide: Literal["off"] = "off"
    target: TargetSection = TargetSection()
    wait_s: float = 0.0


class RideConfig(Section):
    """A whole configuration file of `beamline ride`; the sections beside `ride` are those of a scan."""

    sample: SampleSection
    ride: RideSection
    optics: OpticsSection
    storage: StorageSection = StorageSection()
    monitor: MonitorSection = MonitorSection()
    references: ReferencesSection = ReferencesSection()
    recon: ReconSection = ReconSection()

    @property
    def as_scan(self) -> Config:
        """This configuration for what takes one of a scan: its sections have the names and types of those."""
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
    def _steps_turn(self) -> Self:
        angles = self.ride.angles
        if isinstance(angles, PlanAngles) and angles.views > 1 and not math.fabs(angles.step_deg) > 0:
            raise ValueError(f"ride.angles.step_deg is {angles.step_deg:g}: {angles.views} views need a step")
        if self.monitor.retake:
            raise ValueError("monitor.retake: a ride cannot have views taken again, as the scan is another program's")
        return self


EXAMPLE = """\
# A ride on the scan of another program (docs/areadetector.md). No process variable is written.
# beamline ride FILE --check   shows what the IOC says, and whether two seconds of frames arrive whole.
# Units are in the names: s, deg, mm, um, keV. null means "not known" or "the default".

sample: {name: tooth, description: "", diameter_mm: null}

ride:
  image: "pva://2bmSP2:Pva1:Image"      # PvName of NDPluginPva or NDPluginPvxs
  # from: tomoscan   prefix                             start, step, kinds and counts by its process variables
  #       plan       views, start_deg, step_deg         equal steps from the first projection
  #       attribute  views, name                        of a step scan: an NDAttribute in degrees
  #       panda      views, file, dataset, deg_per_unit, offset_deg   a PandABox's HDF5 file (SWMR)
  angles: {from: tomoscan, prefix: "ca://2bmb:TomoScan:"}
  kinds: null                           # NDAttribute that tells darks and flats (HDF5FrameLocation); null: tomoscan's
                                        # status, or all are projections (darks and flats by --darks, --flats)
  camera: "ca://2bmSP2:cam1:"           # for its port, exposure and counters; null: not asked
  source: null                          # port taken as it is, such as ROI1; null: the camera's own frames
  first_id: null                        # uniqueId of the first projection; null: the first one that comes
  exposure_s: null                      # null: by attribute AcquireTime, tomoscan or the camera
  period_s: null                        # between frames, about, for the queue; null: 100 a second at most
  bits: null                            # of a count; null: those of the pixels' type
  queue_s: 1                            # frames that the server holds for us,
  queue_mb: 512                         #   and of its memory at most
  ring_mb: 2048                         # frames that wait in our memory for the disk
  silence_s: 60                         # without a frame, after which it is said why

optics:
  pixel_size_um: 0.65                   # of an unbinned pixel at the sample
  energy_kev: null
  distance_mm: null
  axis_col: null                        # column of the rotation axis; null: it is searched

storage: {folder: runs}
recon: {live: true, method: r2, axis: auto}
"""
