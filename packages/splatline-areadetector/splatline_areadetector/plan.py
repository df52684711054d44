"""RidePlan: the plan of another program's scan, as far as it is known at the first frame, in the form of the plans of
this program."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.config.load import resolved_yaml
from beamline.core.events import json_of
from beamline.core.text import size
from beamline.monitor.digest import preview_shape
from beamline.plan.plan import Block, FieldPlan, Mode, Place, ScanPlan, Timeline
from beamline.scan.preflight import ReadyScan, ready_scan
from beamline.storage.writers.nxtomo import ScanInfo
from drivers.base.frame import FrameKind
from drivers.base.protocols import CameraSettings, CameraTiming, TriggerSource
from splatline_areadetector.arrays import ArrayFrame
from splatline_areadetector.config import RideConfig

REFERENCES = (FrameKind.DARK, FrameKind.FLAT)
_USUAL_PERIOD = 0.1  # s, if the period is not known; used for the remaining time only


@dataclass(frozen=True, eq=False)
class PlannedBlock:
    """Frames of a kind that follow one another."""

    kind: FrameKind
    n: int


@dataclass(frozen=True, eq=False)
class RidePlan:
    """The scan as its program plans it.

    Attributes:
        blocks: the blocks in the order of acquisition.
        angles: float64 [view] in radians; NaN if only the frames contain them. exposures: exposure in s by kind; a kind
            that is not listed has the exposure of projections. period: time in s between frames; None: not known.
            told_by: source of the plan, for the metadata.
    """

    blocks: tuple[PlannedBlock, ...]
    angles: NDArray[np.float64]
    exposures: Mapping[FrameKind, float]
    period: float | None
    angle_source: str

    def exposure(self, kind: FrameKind) -> float:
        """Exposure in s of the frames of this kind; NaN: not known."""
        return self.exposures.get(kind, self.exposures.get(FrameKind.PROJECTION, math.nan))

    @property
    def first_triggers(self) -> list[int]:
        """The first trigger of each block, counted in the whole plan."""
        return [0, *accumulate(block.n for block in self.blocks[:-1])]


def timeline_of(plan: RidePlan, shape: tuple[int, int], preview_bin: int, free: int) -> Timeline:
    """The plan as the timeline of our own scans. Nothing moves, so no limit applies."""
    period = plan.period or _USUAL_PERIOD
    blocks = tuple(
        Block(
            each.kind,
            Mode.STATIC if each.kind in REFERENCES else Mode.STEP,
            first,
            np.full(each.n, np.nan) if each.kind in REFERENCES else plan.angles,
            plan.exposure(each.kind),
            period,
        )
        for each, first in zip(plan.blocks, plan.first_triggers, strict=True)
    )
    n_frames = sum(block.n for block in blocks)
    frame_bytes = 2 * math.prod(shape)
    total = n_frames * (frame_bytes + 4 * math.prod(preview_shape(shape, preview_bin)))
    remarks = ["another program runs the scan; beamline ride does not pause or repeat anything, and moves no device"]
    if total > free:
        remarks.append(
            f"free space on the disk during the scan: the scan needs {size(total)}, and {size(free)} are free"
        )
    return Timeline(blocks, n_frames * period, frame_bytes, total, 0, 0.0, 0.0, 0.0, (), tuple(remarks), _plan_of(plan))


def _plan_of(plan: RidePlan) -> ScanPlan:
    def field(kind: FrameKind) -> FieldPlan:
        n = [block.n for block in plan.blocks if block.kind is kind]
        before = plan.blocks and plan.blocks[0].kind in REFERENCES
        place = Place.NONE if not n else Place.BOTH if len(n) > 1 else Place.START if before else Place.END
        return FieldPlan(max(n, default=0), place, plan.exposure(kind))

    return ScanPlan(
        plan.angles, Mode.STEP, plan.exposure(FrameKind.PROJECTION), plan.period or 0.0, 0.0,
        field(FrameKind.DARK), field(FrameKind.FLAT), plan.angle_source,
    )  # fmt: skip


def ready_of(config: RideConfig, plan: RidePlan, first: ArrayFrame, runs: Path) -> ReadyScan:
    """The scan of the other program, ready to be recorded, from its plan and its first frame."""
    shape, binning = first.window.shape, first.window.binning
    bits = config.ride.bits or 8 * first.dtype.itemsize
    timing = CameraTiming(shape, plan.period or 0.0, 0.0, 0.0, bits)
    settings = CameraSettings(plan.exposure(FrameKind.PROJECTION), TriggerSource.EXTERNAL, None, binning[0])
    timeline = timeline_of(plan, shape, config.storage.preview_bin, _free(runs))
    optics, known = config.optics, not np.isnan(plan.angles).any()
    plan_values = {
        "scheme": plan.angle_source,
        "exposure_s": plan.exposure(FrameKind.PROJECTION),
        **({"angles_deg": np.degrees(plan.angles).tolist()} if known else {}),
    }
    info = ScanInfo(
        sample=config.sample.name,
        title=config.sample.description,
        diameter_mm=config.sample.diameter_mm,
        pixel_size_mm=1e-3 * optics.pixel_size_um * binning[1],
        energy_kev=optics.energy_kev,
        distance_mm=optics.distance_mm,
        exposure=plan.exposure(FrameKind.PROJECTION),
        period=plan.period,
        axis_col=optics.axis_col,
        plan=json_of(plan_values),
        config=resolved_yaml(config),
        devices={"areadetector": _described(config, first)},
        saturation=float(2**bits - 1),
    )
    return ready_scan(config.as_scan, timeline, settings, timing, info)


def _described(config: RideConfig, first: ArrayFrame) -> dict[str, str | int | float]:
    window = first.window
    return {
        "image": config.ride.image, "rows": window.shape[0], "cols": window.shape[1], "row0": window.offset[0],
        "col0": window.offset[1], "binning": window.binning[0], "type": str(first.dtype), "codec": first.codec,
    }  # fmt: skip


def _free(runs: Path) -> int:
    there = next(place for place in (runs.absolute(), *runs.absolute().parents) if place.exists())
    return shutil.disk_usage(there).free
