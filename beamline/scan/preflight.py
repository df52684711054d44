"""Prepare: a configuration and connected devices become a scan that may start, or a refusal before anything moves."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beamline.config.devices import NoBeamMonitor
from beamline.config.load import Config, plan_of, resolved_yaml
from beamline.instrument.connect import Bench, camera_settings
from beamline.monitor import watch as monitor
from beamline.monitor.digest import digest
from beamline.monitor.flag import Context
from beamline.plan.plan import Mode, ScanPlan, Timeline
from beamline.plan.timeline import work_out
from beamline.scan.dry_run import free_bytes, refuse_violations
from beamline.storage.writers.nxtomo import ScanInfo
from drivers.protocols import CameraSettings, CameraTiming, TriggerSource


@dataclass(frozen=True, eq=False)
class Prepared:
    """A scan that may start.

    Attributes:
        settings: the camera's, as it accepted them for the views.
        timing: what the camera says of them.
        watch: the monitor before the first frame.
        info: what the file will say of the scan.
    """

    plan: ScanPlan
    timeline: Timeline
    settings: CameraSettings
    timing: CameraTiming
    watch: monitor.Watch
    info: ScanInfo


def prepare(config: Config, bench: Bench, runs: Path) -> Prepared:
    """Ask the devices what they can do, and work the plan out for them. Nothing moves.

    Args:
        runs: where the file will be, for the free disk.

    Raises:
        ConfigError: a plan that cannot be, every broken limit, an unknown threshold, or a simulated scene that cannot
            be exposed with the camera's settings.
        DeviceRefused: the camera does not take its settings.
    """
    stage, camera = bench.devices.stage, bench.devices.camera
    plan = plan_of(config)
    settings = camera.configure(camera_settings(config, plan.exposure, TriggerSource.EXTERNAL))
    timing, free = camera.timing, free_bytes(runs)
    axis_col = config.optics.axis_col
    preview_bin = config.storage.preview_bin
    timeline = work_out(
        plan,
        stage.limits,
        stage.to_counts,
        timing,
        axis_col=axis_col,
        preview_bin=preview_bin,
        free_bytes=free,
    )
    refuse_violations(timeline)
    watch = monitor.start(_context(plan, timeline, timing), config.monitor.thresholds)
    # The first call compiles, which must not happen while frames are coming.
    digest(np.zeros(timing.shape, np.uint16), watch.context.saturation, preview_bin)
    if bench.simulated is not None:
        bench.simulated.rehearse()
    return Prepared(plan, timeline, settings, timing, watch, _info(config, bench, plan, timeline))


def _context(plan: ScanPlan, timeline: Timeline, timing: CameraTiming) -> Context:
    views = timeline.views
    starts = np.cumsum([0, *(train.n for train in views.trains)])[:-1]
    return Context(
        saturation=2**timing.bits - 1,
        pixels=math.prod(timing.shape),
        period=views.period if plan.mode is Mode.FLY else None,
        pass_starts=frozenset(starts.tolist()),
    )


def _info(config: Config, bench: Bench, plan: ScanPlan, timeline: Timeline) -> ScanInfo:
    optics, devices, monitor = config.optics, bench.devices, config.devices.beam_monitor
    pixel_size, source_distance, distance = optics.pixel_size_um * 1e-3, None, optics.distance_mm
    if bench.simulated is not None and bench.simulated.cone is not None:
        # The scene's cone, in the words of NXtomo: the pixel is that on the detector.
        source_distance, sdd = bench.simulated.cone
        pixel_size, distance = pixel_size * sdd / source_distance, sdd - source_distance
    asked = {
        "scheme": plan.scheme,
        "mode": plan.mode,
        "exposure_s": plan.exposure,
        "period_s": plan.period,
        "settle_s": plan.settle,
        "darks": {"count": plan.darks.count, "at": plan.darks.at, "exposure_s": plan.darks.exposure},
        "flats": {"count": plan.flats.count, "at": plan.flats.at, "exposure_s": plan.flats.exposure},
        "angles_deg": np.degrees(plan.angles).tolist(),
    }
    return ScanInfo(
        sample=config.sample.name,
        title=config.sample.description,
        pixel_size_mm=pixel_size * config.devices.camera.binning,
        energy_kev=optics.energy_kev,
        distance_mm=distance,
        source_distance_mm=source_distance,
        exposure=plan.exposure,
        period=timeline.views.period,
        axis_col=optics.axis_col,
        plan=json.dumps(asked),
        config=resolved_yaml(config),
        devices={device.name: device.describe() for device in (devices.stage, devices.camera)},
        beam_unit=None if isinstance(monitor, NoBeamMonitor) else monitor.unit,
    )
