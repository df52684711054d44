"""Ground truth: it is at the position of the reconstructed sample, also if rows do not fill the last bin."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.core.events import Event
from beamline.features.simulate.write import scan_of, write_scan
from beamline.projections.corrections.air import Air
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.scenes.scene_file import Truth, binning_of, open_scene, truth_of, write_truth
from beamline.storage.readers.open import open_scan
from drivers.base.clock import SystemClock
from recon.base.volume import Grid
from recon.voxels.direct import fdk
from recon.voxels.fbp import fbp
from simulators.frame.shot import Detector
from tests.beamline.storage.file_layout import names, paths, unmatched

SCENE = """
phantom:
  kind: solids
  solids: [{kind: ellipsoid, semi_axes: [0.1, 0.08, 0.06], attenuation: 4.0, centre: [0.05, 0.02, 0.03]}]
beam: {photons_per_s: 1.0e+6}
axis_offset_px: 1.5
detector: {shape: [35, 46], pixel_size_um: 12.0, exposure_s: 0.005}
scan: {views: 90, darks: 1, flats: 1}
"""
CONE = ("beam.sod=2", "beam.sdd=5", "scan.range_deg=360")


def _silent(event: Event | str) -> None:
    """Nobody listens."""


def _centroid(volume: NDArray[np.float32], grid: Grid) -> tuple[float, ...]:
    weights = np.clip(volume.astype(float), 1.0, None) - 1.0  # streaks are far below a quarter of 4/mm
    axes = ((1, 2), (0, 2), (0, 1))
    along = zip(axes, grid.coordinates(), strict=True)
    return tuple(float((weights.sum(axis=others) * at).sum() / weights.sum()) for others, at in along)


@pytest.mark.parametrize("overrides", [(), CONE], ids=["parallel", "cone"])
@pytest.mark.parametrize("binning", [1, 4])
def test_it_lies_where_the_reconstruction_of_the_file_lies(
    tmp_path: Path, overrides: tuple[str, ...], binning: int
) -> None:
    """With bins of 4 three of the 35 rows are left over, so that a parallel beam's z = 0 is 1.5 rows higher up."""
    (tmp_path / "scene.yaml").write_text(SCENE, encoding="utf-8")
    scene = open_scene(str(tmp_path / "scene.yaml"), overrides)
    scan = scan_of(scene, 0, None, 0.0)
    write_scan(scene, scan, tmp_path / "scan.h5", _silent, SystemClock(), lambda: False)
    truth = truth_of(scan.scene.sample, scan.detector, binning)
    assert truth.names == ("ellipsoid",)
    chosen = Selection(binning=binning, axis_col=24.0, steps=(Air("none"),))
    with open_scan(tmp_path / "scan.h5") as source:
        assert source.axis_col == 24.0
        prepared = prepare_projections(select(source, chosen), _silent)
    grid = Grid.matching(prepared.geometry)
    assert (grid.shape, grid.centre) == (truth.grid.shape, pytest.approx(truth.grid.centre))
    volume = (fdk if overrides else fbp)(prepared.seen.data, prepared.geometry, grid, "hann")
    for found, stands in zip(_centroid(volume, grid), _centroid(truth.values, truth.grid), strict=True):
        assert found == pytest.approx(stands, abs=0.15 * 0.012)
    assert _centroid(truth.labels * np.float32(4), truth.grid) == pytest.approx(
        _centroid(truth.values, truth.grid), abs=0.25 * truth.grid.voxel_size
    )


@pytest.mark.parametrize(
    ("shape", "binning"), [((512, 512), 2), ((256, 100), 1), ((300, 2049), 9), ((1, 2048), 1), ((3, 2048), 3)]
)
def test_unless_asked_otherwise_it_is_at_most_256_across_where_the_frame_lets_it(
    shape: tuple[int, int], binning: int
) -> None:
    assert binning_of(Detector.centred(shape, 0.01)) == binning


def test_the_page_of_the_layout_names_what_its_file_holds(tmp_path: Path) -> None:
    grid = Grid((2, 3, 4), 0.5)
    write_truth(tmp_path / "t.h5", Truth(grid, np.ones(grid.shape, "f4"), np.ones(grid.shape, "u1"), ("ellipsoid",)))
    assert unmatched(paths(tmp_path / "t.h5"), names("Truth file")) == (set(), set())


def test_the_truth_of_particles_is_a_table_beside_the_voxels(tmp_path: Path) -> None:
    small = "phantom.diameter=0.08", "phantom.height=0.05", "phantom.fill=0.3", "phantom.change.state=6"
    scan = scan_of(open_scene("operando", (*small, "detector.shape=[32,64]")), 0, None, 0.0)
    write_truth(tmp_path / "t.h5", truth_of(scan.scene.sample, scan.detector, 1))
    with h5py.File(tmp_path / "t.h5") as file:
        table = {name: column[:] for name, column in file["entry/particles"].items()}
    assert table["particle"].size > 5 and {len(column) for column in table.values()} == {table["particle"].size}
    np.testing.assert_allclose(table["grey"] * (1 + table["growth"]), 1)
    assert table["growth"].max() > 0.03 and (table["charge"] == 1).all()
