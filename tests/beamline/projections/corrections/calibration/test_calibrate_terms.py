"""--calibrate gains: error if the projections cannot show them."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from tests.beamline.cli.test_air import bent_and_straight

pytestmark = pytest.mark.usefixtures("one_thread")

SCENE = """
# A thorax: soft tissue with two lungs, beside spine and ribs. It nearly fills the light of a narrow field.
phantom:
  kind: solids
  solids:
    - {kind: ellipsoid, semi_axes: [0.264, 0.185, 90.0], attenuation: 0.85, name: soft}
    - {kind: ellipsoid, semi_axes: [0.092, 0.119, 90.0], attenuation: -0.6, centre: [-0.119, 0.013, 0.0], name: lung}
    - {kind: ellipsoid, semi_axes: [0.092, 0.119, 90.0], attenuation: -0.6, centre: [0.119, 0.013, 0.0], name: lung}
    - {kind: ellipsoid, semi_axes: [0.04, 0.04, 90.0], attenuation: 1.7, centre: [0.0, 0.132, 0.0], name: bone}
    - {kind: ellipsoid, semi_axes: [0.016, 0.029, 90.0], attenuation: 1.7, centre: [-0.224, 0.0, 0.0], name: bone}
    - {kind: ellipsoid, semi_axes: [0.016, 0.029, 90.0], attenuation: 1.7, centre: [0.224, 0.0, 0.0], name: bone}
beam: {photons_per_s: 3.0e+5}
detector: {shape: [48, 112], pixel_size_um: 6.0, exposure_s: 0.02}
scan: {views: 60, darks: 2, flats: 8}
effects: [BEND, {kind: narrow_field, width: 0.576}, photon_noise, offset]
"""


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return bent_and_straight(SCENE, tmp_path_factory.mktemp("terms"))


def test_gains_of_few_columns_are_refused(scans: dict[str, Path]) -> None:
    done = CliRunner().invoke(main, ["recon", str(scans["bent"]), "--bin", "2", "--calibrate", "gains"])
    assert (
        done.exit_code == 5
        and "projections of 56 columns, and gains needs" in done.output
        and "Nothing was read" in done.output
    )
