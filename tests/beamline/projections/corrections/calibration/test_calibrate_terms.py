"""--calibrate background and gains, from the simulated scan to the record of the volume's file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray

from beamline.cli.main import main
from beamline.projections.corrections.calibration.calibrate import Calibrate
from beamline.projections.prepare import DiskBuffer
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.storage.writers.recon_file import read_reconstruction
from tests.beamline.cli.test_air import bent_and_straight
from tests.beamline.prepared_views import prepare

pytestmark = pytest.mark.usefixtures("one_thread")
SHAPE, VIEWS = (24, 56), 60  # pixels binned by 2

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


def _prepared(path: Path, *terms: str, buffer: DiskBuffer | None = None) -> PreparedProjections:
    return prepare(path, Selection(axis_col=55.5, binning=2, steps=(Calibrate(terms),)), buffer)[0]


def _recon(scan: Path, output: Path, *options: str) -> tuple[str, NDArray[np.float32]]:
    fit = "-m fista-tv --iterations 10 --tv-weight 0.003 --no-report"
    given = ["recon", str(scan), "--axis", "55.5", "--bin", "2", *fit.split()]
    done = CliRunner().invoke(main, [*given, "-o", str(output), *options])
    assert done.exit_code == 0, done.output
    return done.output, read_reconstruction(output).volume.data


@pytest.mark.slow
def test_soft_tissue_beside_bone_in_a_narrow_field_behind_a_bent_beam(scans: dict[str, Path], tmp_path: Path) -> None:
    """`--air auto` finds too few rays beside it. Against the volume behind a straight beam."""
    _, true = _recon(scans["straight"], tmp_path / "true.h5")
    _, plain = _recon(scans["bent"], tmp_path / "plain.h5")
    said, learnt = _recon(scans["bent"], tmp_path / "learnt.h5", "--calibrate", "background")
    assert "Background learnt with the volume: " in said and "taken off" in said
    y, x = (np.arange(n) - (n - 1) / 2 for n in true.shape[1:])
    near = np.hypot(y[:, None], x) < 20
    soft = np.abs(true[2:22, near] / 0.85 - 1) < 0.2
    mass = [each[2:22, near][soft].sum() / true[2:22, near][soft].sum() for each in (plain, learnt)]
    psnr = [10 * np.log10(true.max() ** 2 / np.mean((each - true)[2:22, near] ** 2)) for each in (plain, learnt)]
    assert mass[0] < 0.9 and abs(mass[1] - 1) < 0.07
    assert psnr[1] > psnr[0] + 2


def test_a_straight_beam_stays_as_it_is_and_says_so(scans: dict[str, Path]) -> None:
    plain, learnt = _prepared(scans["straight"]), _prepared(scans["straight"], "background")
    np.testing.assert_array_equal(learnt.projections.data, plain.projections.data)
    assert "views held out confirm none" in learnt.done["calibrate"].sentence


@pytest.mark.slow
def test_slabs_lose_the_same_background_to_the_bit(scans: dict[str, Path]) -> None:
    whole = _prepared(scans["bent"], "background")
    buffer = DiskBuffer(np.empty((VIEWS, *SHAPE), np.float32), 7)
    parts = _prepared(scans["bent"], "background", buffer=buffer)
    assert whole.measured is not None
    np.testing.assert_allclose(
        parts.projections.data[:, whole.measured], whole.projections.data[:, whole.measured], atol=2e-6
    )


@pytest.mark.slow
def test_views_held_out_lose_the_surface_of_their_time(scans: dict[str, Path]) -> None:
    plain = Selection(axis_col=55.5, binning=2, views="fixed:40")
    found, before = (
        prepare(scans["bent"], chosen)[0] for chosen in (plain.with_steps(Calibrate(("background",))), plain)
    )
    assert found.held_out is not None and before.held_out is not None
    taken = before.held_out[0] - found.held_out[0]
    used = before.projections.data - found.projections.data
    assert np.abs(taken.mean(axis=0) - used.mean(axis=0)).max() < 0.2 * np.abs(used).max() > 0


def test_gains_of_few_columns_are_refused(scans: dict[str, Path]) -> None:
    done = CliRunner().invoke(main, ["recon", str(scans["bent"]), "--bin", "2", "--calibrate", "gains"])
    assert done.exit_code == 5 and "56 columns are too few" in done.output and "No view was read" in done.output
