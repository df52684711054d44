"""Rehearsal: turns the configuration of a real instrument into one with simulated devices."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from beamline.config.beam import MotorSection, NoBeamMonitor, NoFilter, NoMonochromator, StageOutputShutter
from beamline.config.devices import DeviceSection, SimulatedOrca
from beamline.config.models import Config
from beamline.config.section import Section
from beamline.config.stages import StageSection
from drivers.orca_quest import SENSOR_SHAPE

_MARK = "_rehearsal"
_ELECTRONS = 5000  # electrons of a pixel in an exposure without a sample: 70 % of its range
_LONGEST = 60  # number of characters of the sample's name before the mark at the end of the name of the run's folder


def rehearsal(config: Config) -> dict[str, Any]:
    """The plain values of the same scan with simulated devices. A configuration for simulated devices is returned
    unchanged.

    All settings of plan, stage and camera stay the same. The position of the rotation axis is that of the scene, so the
    reconstruction must search for it. Unless the section `simulation` of the configuration states otherwise, the scene
    is a battery that fits into the field of view, and the clock is virtual, so that it waits for each simulated frame.
    """
    data = config.model_dump(mode="json")
    if config.simulated:
        return data
    stated = {} if config.simulation is None else config.simulation.model_dump(mode="json", exclude_unset=True)
    data["simulation"] = {"clock": "virtual", "scene": _scene(config), **stated}
    data["devices"] = _devices(config.devices)
    data["sample"]["name"] = f"{config.sample.name[:_LONGEST]}{_MARK}"
    data["optics"]["axis_col"], data["recon"]["axis"] = None, "auto"
    return data


def _scene(config: Config) -> dict[str, Any]:
    """A battery, with air around it, in the region that the camera reads. The brightness of the beam suits the
    exposure."""
    height, width = SENSOR_SHAPE
    row0, col0, rows, cols = getattr(config.devices.camera, "roi", None) or (0, 0, height, width)
    pitch = config.optics.pixel_size_um * 1e-3  # mm
    from_middle = max(abs(row0 - height / 2), abs(row0 + rows - height / 2))
    return {
        "phantom": {"kind": "battery", "field_of_view": [cols * pitch, 2 * from_middle * pitch], "n_particles": 150},
        "beam": {"photons_per_s": _ELECTRONS / config.scan.exposure_s},
        "axis_offset_px": col0 + cols / 2 - width / 2,
        "effects": ["photon_noise", "dark_current", "read_noise", "offset"],
    }


def _devices(real: DeviceSection) -> dict[str, Any]:
    high = real.stage.settings.active_high
    shared = {name: getattr(real.camera, name, None) for name in SimulatedOrca.model_fields}
    camera = {name: value for name, value in shared.items() if value is not None}
    camera |= {"kind": "simulated_orca", "trigger_polarity": "positive" if high else "negative"}
    shutter, simple = real.shutter, {"kind": "simulated"}
    return {
        "stage": _stage(real.stage),
        "camera": camera,
        "shutter": _plain(shutter) if isinstance(shutter, StageOutputShutter) else simple,
        "sample_mover": _motor(real.sample_mover) if isinstance(real.sample_mover, MotorSection) else simple,
        "filter": _filter(real),
        "monochromator": _monochromator(real),
        "beam_monitor": _beam_monitor(real),
    }


def _plain(section: Section) -> dict[str, Any]:
    return section.model_dump(mode="json")


def _stage(stage: StageSection) -> dict[str, Any]:
    """The stage at the port of the simulated controller. It has a separate transcript, which can be compared with that
    of the real stage."""
    stand_in = stage.settings.stand_in
    values = (_stand_in(stage, stand_in) if stand_in else _plain(stage)) | {"port": f"sim://{stand_in or stage.kind}"}
    if values.get("transcript"):
        path = Path(values["transcript"])
        values["transcript"] = str(path.with_name(f"{path.stem}{_MARK}{path.suffix}"))
    return values


def _stand_in(stage: StageSection, kind: str) -> dict[str, Any]:
    """A stage of another kind that can be simulated. It has the same speed and the same smallest distance between
    pulses, and uses the same output."""
    settings, limits = stage.settings, stage.settings.limits()
    same = {"counts_per_turn", "max_speed_deg_s", "low_deg", "high_deg", "active_high", "timeout_s", "transcript"}
    return stage.model_dump(mode="json", include=same) | {
        "kind": kind,
        "acceleration_deg_s2": math.degrees(limits.acceleration),
        "firmware_pulse_s": limits.pulse_spacing / 2,
        "trigger_line": settings.pulse_output,
    }


def _motor(motor: MotorSection) -> dict[str, Any]:
    return _plain(motor) | {"stage": _stage(motor.stage)}


def _filter(real: DeviceSection) -> dict[str, Any]:
    if isinstance(real.filter, NoFilter):
        return _plain(real.filter)
    if isinstance(real.filter, MotorSection):
        return _motor(real.filter)
    return {"kind": "simulated", "places": list(real.filter.places)}


def _monochromator(real: DeviceSection) -> dict[str, Any]:
    monochromator = real.monochromator
    if isinstance(monochromator, NoMonochromator):
        return _plain(monochromator)
    settle = getattr(monochromator, "settle_s", None)
    return {"kind": "simulated", "range_kev": monochromator.range_kev} | (
        {} if settle is None else {"settle_s": settle}
    )


def _beam_monitor(real: DeviceSection) -> dict[str, Any]:
    """A simulated beam monitor that shows a constant intensity. The limits of the real monitor do not apply to this
    intensity."""
    monitor = real.beam_monitor
    if monitor.counterpart is None:
        return _plain(NoBeamMonitor())
    return _plain(monitor) | {"port": f"sim://{monitor.counterpart}", "pause_below": None, "resume_above": None}
