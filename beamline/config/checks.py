"""Configuration checks: conditions between several values; each error names its key."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from beamline.config.devices import DcamOrca
from beamline.config.models import Config, FileAngles
from beamline.plan.plan import Mode
from drivers.base.protocols import CameraSettings, TriggerSource


def faults(config: Config, shipped: Path) -> Iterator[tuple[tuple[str, ...], str]]:
    """Key path and sentence of each fault; `shipped`: folder of the configurations that come with the package."""
    yield from _files(config, shipped)
    yield from _camera(config)
    yield from _triggers(config)


def _files(config: Config, shipped: Path) -> Iterator[tuple[tuple[str, ...], str]]:
    angles, simulation = config.scan.angles, config.simulation
    if isinstance(angles, FileAngles) and not Path(angles.path).is_file():
        yield (
            ("scan", "angles", "path"),
            f"scan.angles.path: there is no file {angles.path}; expected one angle in degrees a line",
        )
    if simulation is None or not isinstance(simulation.scene, str):
        return
    if not (shipped / simulation.scene).is_file():
        scenes = " | ".join(f"scenes/{path.name}" for path in sorted((shipped / "scenes").glob("*.yaml")))
        yield (
            ("simulation", "scene"),
            f"simulation.scene: there is no file {simulation.scene}; expected one beside this file, or {scenes}",
        )


_ONE_FRAME_A_PULSE = {"trigger_mode": ("normal",), "trigger_times": (1,), "trigger_active": ("edge", "level")}


def _triggers(config: Config) -> Iterator[tuple[tuple[str, ...], str]]:
    """Camera settings with which a fly scan's pulse does not give one frame of the planned exposure."""
    camera, stage, scan = config.devices.camera, config.devices.stage, config.scan
    if not isinstance(camera, DcamOrca) or scan.mode is not Mode.FLY:
        return
    for key, fit in _ONE_FRAME_A_PULSE.items():
        if (value := getattr(camera, key)) not in fit:
            yield (
                ("devices", "camera", key),
                f"devices.camera.{key} {value} does not give one frame a pulse, which a fly scan needs; expected "
                f"{' | '.join(map(str, fit))}, or scan.mode: step",
            )
    width = stage.settings.wiring.pulse_width
    if camera.trigger_active == "level" and (width is None or abs(width - scan.exposure_s) > 0.01 * scan.exposure_s):
        yield (
            ("devices", "camera", "trigger_active"),
            f"devices.camera.trigger_active level exposes while the pulse lasts; set devices.stage.pulse_width_s "
            f"({width}) to scan.exposure_s ({scan.exposure_s:g}), or trigger_active: edge",
        )


def _camera(config: Config) -> Iterator[tuple[tuple[str, ...], str]]:
    camera = config.devices.camera
    settings = CameraSettings(
        config.scan.exposure_s, TriggerSource.EXTERNAL, camera.roi, camera.binning, camera.readout
    )
    try:
        timing = camera.timing_of(settings)
    except ValueError as error:
        yield ("devices", "camera"), f"devices.camera: {error}"
        return
    axis, last = config.recon.axis, timing.shape[1] - 1
    if isinstance(axis, float) and not -0.5 <= axis <= last + 0.5:
        yield ("recon", "axis"), f"recon.axis {axis:g} lies outside the frame's columns 0 ... {last}"
