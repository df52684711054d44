"""The smallest valid configuration, written to a file and loaded; and the message about an invalid one."""

from pathlib import Path

import pytest

from beamline.config import load as config
from beamline.config.models import Config
from beamline.core.errors import ConfigError

CONFIGS = ("simulated", "instrument", "demo")
GOOD = """\
sample: {name: test}
scan:
  angles: {scheme: fixed, views: 12}
  exposure_s: 0.01
  period_s: 5e-2
devices:
  stage: {kind: pm16c, port: "sim://pm16c", counts_per_turn: 360000, max_speed_deg_s: 30, acceleration_deg_s2: 60}
  camera: {kind: simulated_orca, roi: [0, 0, 8, 8]}
  shutter: {kind: simulated}
  sample_mover: {kind: simulated}
optics: {pixel_size_um: 5}
simulation: {}
"""


def write(folder: Path, text: str = GOOD, name: str = "my.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def load(path: Path, *overrides: str, **environment: str) -> Config:
    return config.load(path, overrides, environment)


def faults(folder: Path, text: str, *overrides: str, **environment: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(write(folder, text), *overrides, **environment)
    assert caught.value.exit_code == 2
    return str(caught.value).replace(str(folder / "my.yaml"), "my.yaml")
