"""Planned: angles, blocks of frames, camera settings and offset positions that a configuration plans."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.config.beam import StageMover
from beamline.config.models import (
    Config,
    Fields,
    FileAngles,
    GoldenAngles,
    InterlacedAngles,
    RandomAngles,
    SectorAngles,
)
from beamline.core.errors import ConfigError
from beamline.core.files import text_in
from beamline.plan import plan as plans
from beamline.plan.plan import FieldPlan, ScanPlan
from drivers.base.protocols import CameraSettings, TriggerSource


def plan_of(config: Config) -> ScanPlan:
    """The scan that a configuration asks for.

    Raises:
        ConfigError: an angle file cannot be read, or the projections cannot be divided into the passes.
    """
    scan = config.scan
    try:
        theta = _angles(scan.angles)
    except (ValueError, OSError) as error:
        where = f"scan.angles.path: {scan.angles.path}" if isinstance(scan.angles, FileAngles) else "scan.angles"
        raise ConfigError(f"{where}: {error}. Nothing was started.") from None
    return ScanPlan(
        angles=np.repeat(theta, scan.frames_per_view),
        frames_per_view=scan.frames_per_view,
        mode=scan.mode,
        exposure=scan.exposure_s,
        period=scan.period_s,
        settle=scan.settle_s,
        warm_up=scan.warm_up_s,
        offset_views=scan.offset_views,
        offset_places=offset_places(config),
        filter=scan.filter,
        energy=scan.energy,
        darks=_field(scan.darks, scan.exposure_s),
        flats=_field(scan.flats, scan.exposure_s),
        scheme=scan.angles.scheme,
        pass_views=scan.pass_views,
        retake_share=config.monitor.retake_share if config.monitor.retake else 0.0,
    )


def _angles(plan: Any) -> NDArray[np.float64]:
    match plan:
        case SectorAngles():
            return plans.sector(plan.views, math.radians(plan.first_deg), math.radians(plan.last_deg))
        case FileAngles():
            return plans.from_text(text_in(Path(plan.path)))
    start, span = math.radians(plan.start_deg), math.radians(plan.span_deg)
    match plan:
        case RandomAngles():
            return plans.random(plan.views, start, span, rng=np.random.default_rng(plan.seed))
        case InterlacedAngles():
            return plans.interlaced(plan.views, plan.passes, start, span)
        case GoldenAngles():
            return plans.golden(plan.views, start, span)
    return plans.fixed(plan.views, start, span)


def _field(fields: Fields, exposure: float) -> FieldPlan:
    return FieldPlan(fields.count, fields.at, exposure if fields.exposure_s is None else fields.exposure_s)


def camera_settings(config: Config, exposure: float, trigger: TriggerSource) -> CameraSettings:
    """The configured region, binning and readout with an exposure (s) and a trigger source."""
    camera = config.devices.camera
    return CameraSettings(exposure, trigger, camera.roi, camera.binning, camera.readout)


def offset_places(config: Config) -> tuple[float, ...]:
    """Positions of the sample in mm for laterally offset projections. They are 0.9 of the field of view apart, and end
    when a twentieth of the field of view shows air beyond the sample, on both sides. Raises ValueError with the reason
    if this is impossible.
    """
    mover, camera, diameter = config.devices.sample_mover, config.devices.camera, config.sample.diameter_mm
    if not config.scan.offset_views:
        return ()
    if diameter is None:
        raise ValueError("set sample.diameter_mm, which determines how far the sample is stepped")
    per_unit = mover.mm_per_deg if isinstance(mover, StageMover) else float(mover.kind == "simulated")
    if not per_unit:
        raise ValueError(
            "devices.sample_mover cannot step the sample: set devices.sample_mover.kind to stage, and "
            "set devices.sample_mover.mm_per_deg"
        )
    settings, axis = camera_settings(config, config.scan.exposure_s, TriggerSource.EXTERNAL), config.optics.axis_col
    cols = camera.timing_of(settings).shape[1]
    field = 1e-3 * config.optics.pixel_size_um * camera.binning * cols
    off_middle = 0.0 if axis is None else abs((axis + 0.5) / cols - 0.5)
    n = math.ceil((diameter / field / 2 + off_middle - 0.45) / 0.9)
    if n < 1:
        raise ValueError(
            f"the field of view of {field:.4g} mm shows all of a sample of {diameter:.4g} mm; set "
            "scan.offset_views to 0"
        )
    places = tuple(0.9 * field * step for step in range(-n, n + 1) if step)
    if isinstance(mover, StageMover):
        mover.refuse_unreachable(
            {
                f"the position of the sample mover for an offset of {mm:.4g} mm,": mover.in_deg + mm / per_unit
                for mm in places
            }
        )
    return places
