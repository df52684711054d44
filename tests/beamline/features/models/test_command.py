"""voxelise, render and export --gaussians: what a volume's file keeps of its Gaussians gives the same again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.features.models.made import write_views
from beamline.gaussians.model import read_model
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.recon_file import read_reconstruction, write_reconstruction
from tests.beamline.cli.small_scan import beamline

pytestmark = pytest.mark.usefixtures("one_thread")
FIT = ("-m", "r2", "--steps", "20", "--gaussians", "80", "--no-report")


def _made(*arguments: str) -> str:
    result = beamline(*arguments)
    assert result.exit_code == 0, result.output
    return str(result.output)


def test_the_voxels_of_the_model_are_those_of_the_volume(folder: Path) -> None:
    _made("recon", "scan.h5", *FIT, "--finish", "0", "-o", "v.h5")
    _made("voxelise", "v.h5", "-o", "again.h5")
    volume, again = read_reconstruction(folder / "v.h5").volume, read_reconstruction(folder / "again.h5").volume
    assert again.grid == volume.grid
    np.testing.assert_allclose(again.data, volume.data, atol=1e-5 * volume.data.max())


def test_a_box_of_finer_voxels_is_the_same_field(folder: Path) -> None:
    _made("recon", "scan.h5", *FIT, "--finish", "0", "-o", "v.h5")
    grid = read_reconstruction(folder / "v.h5").volume.grid
    (x0, y0, z0), (x1, y1, z1) = grid.edges
    box = f"{z0}:{z1},{y0 / 2}:{y1 / 2},{x0 / 2}:{x1 / 2}"
    _made("voxelise", "v.h5", "--voxel", str(grid.voxel_size / 3), "--box", box, "-o", "fine.h5")
    fine = read_reconstruction(folder / "fine.h5").volume
    nz, ny, nx = grid.shape
    assert fine.grid.shape == (3 * nz, 3 * ny // 2, 3 * nx // 2)
    coarse = read_reconstruction(folder / "v.h5").volume.data[:, ny // 4 : -(ny // 4), nx // 4 : -(nx // 4)]
    np.testing.assert_allclose(fine.data[1::3, 1::3, 1::3], coarse, atol=1e-5 * coarse.max())


def test_views_of_the_model_are_a_scan_that_gives_the_volume_again(folder: Path) -> None:
    _made("recon", "scan.h5", *FIT, "-o", "v.h5")
    _made("render", "v.h5", "-o", "views.h5", "--angles", "0:180:4.5")
    model = read_model(folder / "v.h5")
    with h5py.File(folder / "views.h5") as file:
        assert file["exchange/data"].shape == (40, *model.geometry.detector_shape)
        np.testing.assert_allclose(file["exchange/theta"][()], 4.5 * np.arange(40))
    _made("recon", "views.h5", "-m", "fbp", "--no-report", "-o", "w.h5")
    _made("voxelise", "v.h5", "-o", "u.h5")
    found, known = (read_reconstruction(folder / name).volume.data for name in ("w.h5", "u.h5"))
    assert np.corrcoef(found.ravel(), known.ravel())[0, 1] > 0.98


def test_a_volume_with_error_bars_and_fbp_beside_it_is_voxelised_without_them(folder: Path) -> None:
    _made("recon", "scan.h5", *FIT, "--uncertainty", "-o", "v.h5")
    made = read_reconstruction(folder / "v.h5")
    assert made.deviation is not None
    write_reconstruction(folder / "w.h5", replace(made, fbp=made.volume.data))
    _made("voxelise", "w.h5", "-o", "again.h5")
    again = read_reconstruction(folder / "again.h5")
    assert again.deviation is None and again.fbp is None and again.volume.grid == made.volume.grid


def test_views_of_a_model_of_displaced_views_are_in_their_place(folder: Path) -> None:
    _made("recon", "scan.h5", *FIT, "-o", "v.h5")
    straight = read_model(folder / "v.h5")
    moved = replace(
        straight, geometry=replace(straight.geometry, shifts=straight.geometry.shifts + np.array([3.0, 1.0]))
    )
    for name, model in (("a.h5", straight), ("b.h5", moved)):
        write_views(folder / name, model, np.array([0.3]), lambda n, of: None)
    with h5py.File(folder / "a.h5") as a, h5py.File(folder / "b.h5") as b:
        np.testing.assert_array_equal(a["exchange/data"], b["exchange/data"])


def test_a_ply_holds_every_gaussian(folder: Path) -> None:
    _made("recon", "scan.h5", *FIT, "-o", "v.h5")
    said = _made("export", "v.h5", "--gaussians", "-o", "v.ply")
    model = read_model(folder / "v.h5").gaussians
    head, _, body = (folder / "v.ply").read_bytes().partition(b"end_header\n")
    assert f"element vertex {model.n}".encode() in head and str(model.n) in said
    rows = np.frombuffer(body, "<f4").reshape(model.n, 11)
    np.testing.assert_array_equal(rows[:, :3], model.means.numpy())
    np.testing.assert_allclose(rows[:, 10], model.densities.numpy(), rtol=1e-5)


REFUSED = [
    (("voxelise", "f.h5", "-o", "x.h5"), 5, "holds no Gaussians"),
    (("render", "f.h5", "-o", "x.h5"), 5, "holds no Gaussians"),
    (("render", "f.h5", "-o", "x.tif"), 2, "views are HDF5"),
    (("render", "f.h5", "-o", "x.h5", "--angles", "0:180:0"), 2, "names no angles"),
    (("render", "f.h5", "-o", "x.h5", "--angles", "nan"), 2, "names no angles"),
    (("voxelise", "f.h5", "-o", "x.h5", "--box", "0:1,0:1"), 2, "is no box"),
    (("export", "f.h5", "-o", "x.ply"), 2, "--gaussians goes with the suffix .ply"),
    (("export", "f.h5", "-o", "x.tif", "--gaussians"), 2, "--gaussians goes with the suffix .ply"),
    (("export", "f.h5", "-o", "x.ply", "--gaussians", "--bits", "8"), 2, "does not go with"),
]


def test_a_volume_without_gaussians_and_bad_names_are_refused(folder: Path) -> None:
    _made("recon", "scan.h5", "-m", "fbp", "--no-report", "-o", "f.h5")
    for arguments, code, said in REFUSED:
        result = beamline(*arguments)
        assert result.exit_code == code and said in result.stderr + str(result.exception), (arguments, result.output)
        assert not list(folder.glob("x.*"))


def test_views_of_a_cone_state_their_cone_and_one_that_no_file_states_is_refused(folder: Path) -> None:
    _made("recon", "scan.h5", *FIT, "-o", "v.h5")
    model = read_model(folder / "v.h5")
    cone = replace(model, geometry=replace(model.geometry, sod=100.0, sdd=250.0))
    write_views(folder / "views.h5", cone, np.radians([0.0, 90.0]), lambda n, of: None)
    with open_scan(folder / "views.h5") as source:
        assert source.cone == pytest.approx((100.0, 250.0)) and source.quantity == "line_integrals"
        assert source.pixel_size_mm == cone.geometry.pixel_pitch and source.axis_col == cone.geometry.axis_col
        np.testing.assert_allclose(source.angles, np.radians([0.0, 90.0]))
    off_middle = replace(cone, geometry=replace(cone.geometry, axis_row=7.0))
    with pytest.raises(DataError, match="the middle row"):
        write_views(folder / "x.h5", off_middle, np.zeros(1), lambda n, of: None)
    assert not list(folder.glob("x.*"))
