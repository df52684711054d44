"""Preflight: checks a scan with connected devices before anything moves. `dry_run` plans it without devices."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beamline.config.beam import NoBeamMonitor
from beamline.config.load import Config, resolved_yaml
from beamline.config.monitor import configured_checks
from beamline.config.planned import camera_settings, plan_of
from beamline.core.events import json_of
from beamline.instrument.connect import ConnectedDevices
from beamline.monitor.check import ScanContext
from beamline.monitor.digest import digests
from beamline.monitor.watch import Monitor, usual_step
from beamline.monitor.watch import start as start_monitor
from beamline.plan.plan import Mode, ScanPlan, Timeline
from beamline.scan.dry_run import Remaining, all_of, disk_of, refuse_violations, timeline_of, with_lock_violation
from beamline.storage.writer_lock import no_locks
from beamline.storage.writers.nxtomo import ScanInfo
from drivers.base.protocols import CameraSettings, CameraTiming, TriggerSource


@dataclass(frozen=True, eq=False)
class ReadyScan:
    """A scan that is ready to start."""

    plan: ScanPlan
    timeline: Timeline
    settings: CameraSettings  # settings of the camera for the projections, as the camera has accepted them
    timing: CameraTiming  # timing of the camera with these settings
    monitor: Monitor  # before the first frame
    info: ScanInfo  # metadata that are written into the file before the first frame


def preflight(
    config: Config,
    instrument: ConnectedDevices,
    runs: Path,
    remaining: Remaining = all_of,
    check_stop: Callable[[], None] = lambda: None,
) -> ReadyScan:
    """Read the limits of the devices, and compute the plan for them. Nothing moves.

    Args:
        runs: folder in which the file will be, for the free disk space. remaining: function that returns the part of
            the plan that must still be taken. check_stop: function that is called between long steps, such as loading
            kernels; an exception from it ends the work.

    Raises:
        ConfigError: the plan is impossible, limits are exceeded (all are listed), or the simulated scene cannot be
            exposed with the settings of the camera.
        DeviceRefused: the camera does not accept its settings.
    """
    stage, camera = instrument.devices.stage, instrument.devices.camera
    plan = remaining(plan_of(config))
    settings = camera.configure(camera_settings(config, plan.exposure, TriggerSource.EXTERNAL))
    timing, disk = camera.timing, disk_of(runs)
    free = shutil.disk_usage(disk).free
    timeline = with_lock_violation(
        timeline_of(config, plan, stage.limits, stage.to_counts, timing, free), no_locks(disk)
    )
    refuse_violations(timeline)
    ready = ready_scan(config, timeline, settings, timing, _info(config, instrument, plan, timeline), check_stop)
    if instrument.simulated is not None:
        instrument.simulated.rehearse()
    return ready


def ready_scan(
    config: Config,
    timeline: Timeline,
    settings: CameraSettings,
    timing: CameraTiming,
    info: ScanInfo,
    check_stop: Callable[[], None] = lambda: None,
) -> ReadyScan:
    """A planned scan, with the state of the monitor before the first frame. The sections `monitor` and `storage` of
    `config` are used."""
    monitor = start_monitor(_context(timeline.plan, timeline, timing, info), configured_checks(config.monitor))
    # The first call compiles kernels, which must not happen while frames arrive.
    check_stop()
    digests(np.zeros(timing.shape, np.uint16), monitor.context.saturation, config.storage.preview_bin)
    check_stop()
    return ReadyScan(timeline.plan, timeline, settings, timing, monitor, info)


def _context(plan: ScanPlan, timeline: Timeline, timing: CameraTiming, info: ScanInfo) -> ScanContext:
    return ScanContext(
        saturation=_saturation(timing),
        pixels=math.prod(timing.shape),
        period=timeline.views.period if plan.mode is Mode.FLY else None,
        # in the form in which the file states them
        step=usual_step(np.radians(np.degrees(plan.angles[:: plan.frames_per_view]))),
        frames_per_view=plan.frames_per_view,
        stored=plan.stored,
        cone=info.source_distance_mm is not None,
        axis_col=info.axis_col,
    )


def _saturation(timing: CameraTiming) -> int:
    """The number of counts from which a pixel counts as saturated."""
    return int(2**timing.bits - 1)


def _info(config: Config, instrument: ConnectedDevices, plan: ScanPlan, timeline: Timeline) -> ScanInfo:
    plan_values = {
        "scheme": plan.scheme,
        "mode": plan.mode,
        "exposure_s": plan.exposure,
        "period_s": plan.period,
        "settle_s": plan.settle,
        "warm_up_s": plan.warm_up,
        **({"frames_per_view": plan.frames_per_view} if plan.frames_per_view > 1 else {}),
        **({"offset_views": plan.offset_views, "offset_places_mm": plan.offset_places} if plan.offset_places else {}),
        "darks": {"count": plan.darks.count, "at": plan.darks.at, "exposure_s": plan.darks.exposure},
        "flats": {"count": plan.flats.count, "at": plan.flats.at, "exposure_s": plan.flats.exposure},
        "angles_deg": np.degrees(plan.angles).tolist(),
    }
    device_values = scan_info(config, instrument)
    return replace(
        device_values,
        saturation=_saturation(instrument.devices.camera.timing),
        exposure=plan.exposure,
        period=timeline.views.period,
        plan=json_of(plan_values),
        offset_views=bool(plan.offset_places),
        decides=config.scan.decide != "off",
        filter=plan.filter or device_values.filter,
        energy_kev=plan.energy or device_values.energy_kev,
        monochromator_kev=plan.energy or device_values.monochromator_kev,
    )


def scan_info(config: Config, instrument: ConnectedDevices) -> ScanInfo:
    """Metadata of the file that do not depend on the plan. Filter and energy have their present values. Raises
    DeviceError if a device does not answer.
    """
    optics, devices, monitor = config.optics, instrument.devices, config.devices.beam_monitor
    pixel_size, source_distance, distance = optics.pixel_size_um * 1e-3, None, optics.distance_mm
    if instrument.simulated is not None and instrument.simulated.cone is not None:
        # The cone beam of the scene in the form of NXtomo, in which the pixel size is that on the detector.
        source_distance, sdd = instrument.simulated.cone
        pixel_size, distance = pixel_size * sdd / source_distance, sdd - source_distance
    energy = None if devices.monochromator is None else devices.monochromator.energy()
    return ScanInfo(
        sample=config.sample.name,
        title=config.sample.description,
        diameter_mm=config.sample.diameter_mm,
        pixel_size_mm=pixel_size * config.devices.camera.binning,
        energy_kev=energy or optics.energy_kev,
        monochromator_kev=energy,
        distance_mm=distance,
        source_distance_mm=source_distance,
        axis_col=optics.axis_col,
        config=resolved_yaml(config),
        devices={device.name: device.describe() for device in (devices.stage, devices.camera)},
        filter=None if devices.filter is None else devices.filter.place(),
        beam_unit=None if isinstance(monitor, NoBeamMonitor) else monitor.unit,
    )
