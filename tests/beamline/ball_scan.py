"""A small scan of a ball away from the axis, for any simulated stage on a virtual clock; the images show the angles."""

from functools import cache
from typing import Any

import numpy as np

from beamline.config import load as config
from beamline.config.models import Config
from beamline.config.planned import camera_settings
from beamline.instrument import connect as devices
from beamline.plan.plan import Block
from beamline.plan.timeline import passes
from drivers.base.protocols import TriggerSource

# A ball away from the axis and no effects: every frame follows Beer-Lambert, so its angle can be read from the image.
BALL = {
    "phantom": {
        "kind": "solids",
        "solids": [
            {"kind": "ellipsoid", "semi_axes": [0.02, 0.02, 0.02], "attenuation": 30.0, "centre": [0.06, 0, 0.01]}
        ],
    },
    "beam": {"photons_per_s": 1.0e5},
}


@cache
def shipped(name: str, *overrides: str) -> Config:
    """The shipped configuration, read once."""
    return config.load(config.config_folder() / f"{name}.yaml", overrides, {})


def small(*overrides: str) -> Config:
    loaded = shipped("simulated", "devices.camera.roi=[1136, 2028, 32, 40]", "simulation.clock=virtual", *overrides)
    return with_scene(loaded, BALL)


def with_scene(settings: Config, scene: dict[str, Any]) -> Config:
    """Settings of a simulated instrument with another scene."""
    assert settings.simulation is not None
    simulation = settings.simulation.model_copy(update={"scene": scene})
    return settings.model_copy(update={"simulation": simulation})


def fly(instrument: devices.ConnectedDevices, block: Block, settings: Config) -> tuple[list[int], np.ndarray]:
    """Run the passes of a block as acquisition does; returns framestamps and counts [frame, row, col]."""
    stage, camera = instrument.devices.stage, instrument.devices.camera
    camera.configure(camera_settings(settings, block.exposure, TriggerSource.EXTERNAL))
    stamps, images = [], []
    camera.arm(block.n)
    for flown in passes(block):
        stage.start_move(flown.start, stage.limits.max_speed)
        stage.wait(60.0)
        stage.arm(flown.train)
        stage.start_move(flown.end, block.speed)
        for _ in range(flown.train.n):
            frame = camera.next_frame(10.0)
            stamps.append(frame.framestamp)
            images.append(frame.counts)
        stage.wait(60.0)
    camera.disarm()
    return stamps, np.array(images)


COMMON = "counts_per_turn: 360000, max_speed_deg_s: 30, acceleration_deg_s2: 60, low_deg: -20"


STAGES = {
    "pm16c": f"{{kind: pm16c, port: 'sim://pm16c', channel: 3, {COMMON}}}",
    "pm16c, 10 us": f"{{kind: pm16c, port: 'sim://pm16c', pulse_width_s: 1.0e-5, {COMMON}}}",
    "pm16c, an interval after": f"{{kind: pm16c, port: 'sim://pm16c', first_pulse: interval_after, {COMMON}}}",
    "pi_gcs": f"{{kind: pi_gcs, port: 'sim://pi_gcs', axis: A, trigger_line: 2, {COMMON}}}",
    "pi_gcs, a step after": f"{{kind: pi_gcs, port: 'sim://pi_gcs', first_pulse: step_after, {COMMON}}}",
    "zaber": f"{{kind: zaber, port: 'sim://zaber', device: 2, output: 3, {COMMON}}}",
    "pi_gcs, falling": f"{{kind: pi_gcs, port: 'sim://pi_gcs', active_high: false, firmware_pulse_s: 0.1, {COMMON}}}",
    "zaber, falling": f"{{kind: zaber, port: 'sim://zaber', active_high: false, {COMMON}}}",
    "zaber, toggled": f"{{kind: zaber, port: 'sim://zaber', toggle: true, {COMMON}}}",
    "zaber, unchained": f"{{kind: zaber, port: 'sim://zaber', chained: false, {COMMON}}}",
}
