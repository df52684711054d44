"""Faults: finds values of a configuration that are legal alone, but not together."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from beamline.config.devices import DcamOrca
from beamline.config.models import Config, FileAngles
from beamline.config.planned import camera_settings, offset_places
from beamline.core.quantities import doubt, is_impossible
from beamline.plan.plan import Mode
from drivers.base.protocols import TriggerSource


def faults(config: Config, shipped: Path) -> Iterator[tuple[tuple[str, ...], str]]:
    """Key path and message of each fault. shipped: folder with the configurations that come with the package."""
    yield from _files(config, shipped)
    yield from _camera(config)
    yield from _triggers(config)
    numbers = ((keys, ".".join(keys), value) for keys, value in quantities(config.model_dump(exclude={"simulation"})))
    yield from ((keys, doubt(name, value)) for keys, name, value in numbers if is_impossible(name, value))
    try:
        offset_places(config)
    except ValueError as error:
        yield ("scan", "offset_views"), f"scan.offset_views {config.scan.offset_views}: {error}"


def _files(config: Config, shipped: Path) -> Iterator[tuple[tuple[str, ...], str]]:
    angles, simulation = config.scan.angles, config.simulation
    if isinstance(angles, FileAngles) and not Path(angles.path).is_file():
        yield (
            ("scan", "angles", "path"),
            f"scan.angles.path: there is no file {angles.path}; expected a file with the angles in degrees",
        )
    if (missing := config.recon.missing_reference) is not None:
        yield ("recon", "reference"), missing
    scene = simulation.scene if simulation is not None else None
    if isinstance(scene, str) and not (shipped / scene).is_file():
        scenes = " | ".join(f"scenes/{path.name}" for path in sorted((shipped / "scenes").glob("*.yaml")))
        key = ("simulation", "scene")
        yield (
            key,
            f"simulation.scene: there is no file {scene}; expected one next to the configuration file, or {scenes}",
        )


def quantities(values: Any, keys: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], float]]:
    """Key path and value of each number in plain values. If a key has several numbers, they share its path."""
    if isinstance(values, dict | list | tuple):
        for name, each in values.items() if isinstance(values, dict) else ((None, each) for each in values):
            yield from quantities(each, keys if name is None else (*keys, str(name)))
    elif isinstance(values, int | float) and not isinstance(values, bool):
        yield keys, values


_ONE_FRAME_A_PULSE = {"trigger_mode": ("normal",), "trigger_times": (1,), "trigger_active": ("edge", "level")}


def _triggers(config: Config) -> Iterator[tuple[tuple[str, ...], str]]:
    """Faults of camera settings: with them, a pulse of a fly scan would not give one frame of the planned exposure."""
    camera, stage, scan = config.devices.camera, config.devices.stage, config.scan
    if not isinstance(camera, DcamOrca) or scan.mode is not Mode.FLY:
        return
    for key, fit in _ONE_FRAME_A_PULSE.items():
        if (value := getattr(camera, key)) not in fit:
            expected = f"expected {' | '.join(map(str, fit))}, or scan.mode: step"
            fault = (
                f"devices.camera.{key} {value} does not give one frame per pulse, which a fly scan needs; {expected}"
            )
            yield ("devices", "camera", key), fault
    width = stage.settings.pulse_width
    if camera.trigger_active == "level" and (width is None or abs(width - scan.exposure_s) > 0.01 * scan.exposure_s):
        yield (
            ("devices", "camera", "trigger_active"),
            "with devices.camera.trigger_active: level, the exposure lasts as long as the pulse. Set "
            f"devices.stage.pulse_width_s (now {'null' if width is None else width}) to the value of scan.exposure_s "
            f"({scan.exposure_s:g}), or set devices.camera.trigger_active to edge",
        )


def _camera(config: Config) -> Iterator[tuple[tuple[str, ...], str]]:
    camera = config.devices.camera
    settings = camera_settings(config, config.scan.exposure_s, TriggerSource.EXTERNAL)
    try:
        timing = camera.timing_of(settings)
    except ValueError as error:
        yield ("devices", "camera"), f"devices.camera: {error}"
        return
    axis, last = config.recon.axis, timing.shape[1] - 1
    if isinstance(axis, float) and not -0.5 <= axis <= last + 0.5:
        yield ("recon", "axis"), f"recon.axis {axis:g} lies outside the frame's columns 0 ... {last}"
