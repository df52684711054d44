"""Configuration checks: what no single value's type can say, each fault with the key that it is about."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from beamline.config_models import Config, DcamOrca, FileAngles
from drivers import orca_quest
from drivers.protocols import CameraSettings, TriggerSource


def faults(config: Config, shipped: Path) -> Iterator[tuple[tuple[str, ...], str]]:
    """Key path and sentence of each fault.

    Args:
        shipped: the folder of the configurations that come with the package.
    """
    yield from _files(config, shipped)
    yield from _camera(config)


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


def _camera(config: Config) -> Iterator[tuple[tuple[str, ...], str]]:
    camera = config.devices.camera
    settings = CameraSettings(
        config.scan.exposure_s, TriggerSource.EXTERNAL, camera.roi, camera.binning, camera.readout
    )
    try:
        timing = orca_quest.timing(settings, camera.link if isinstance(camera, DcamOrca) else "usb3")
    except ValueError as error:
        yield ("devices", "camera"), f"devices.camera: {error}"
        return
    axis, last = config.recon.axis, timing.shape[1] - 1
    if isinstance(axis, float) and not -0.5 <= axis <= last + 0.5:
        yield ("recon", "axis"), f"recon.axis {axis:g} lies outside the frame's columns 0 ... {last}"
