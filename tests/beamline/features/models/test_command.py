"""`beamline voxelise`, `render`, `surface`."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.features.models.made import write_views
from beamline.gaussians import read_model
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.recon_file import read_reconstruction
from recon.features.surfaces import density_at
from tests.beamline.cli.small_scan import beamline, left

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


def test_a_volume_with_error_bars_is_voxelised_without_them(folder: Path) -> None:
    _made("recon", "scan.h5", *FIT, "--uncertainty", "-o", "v.h5")
    made = read_reconstruction(folder / "v.h5")
    assert made.deviation is not None
    _made("voxelise", "v.h5", "-o", "again.h5")
    again = read_reconstruction(folder / "again.h5")
    assert again.deviation is None and again.volume.grid == made.volume.grid


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
    (("voxelise", "f.h5", "-o", "x.h5", "--box", "0:1,0:1"), 2, "is not a box"),
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


pytest.importorskip("skimage")


@pytest.fixture
def ball(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A ball of radius 0.5 mm in voxels of 0.1 mm, as .npz, in the working folder."""
    monkeypatch.chdir(tmp_path)
    z, y, x = (np.indices((14, 14, 14)) - 6.5) * 0.1
    data = np.clip(0.5 - (np.sqrt(x * x + y * y + z * z) - 0.5) / 0.2, 0, 1).astype(np.float32)
    np.savez(tmp_path / "ball.npz", volume=data, voxel_mm=0.1)
    return tmp_path


def _stl(path: Path) -> NDArray[np.float32]:
    """Triangles [n, corner, xyz] of a binary STL."""
    raw = path.read_bytes()
    assert b"lengths in mm" in raw[:80] and not raw.startswith(b"solid")
    rows = np.frombuffer(raw[84:], np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")]))
    assert len(rows) == np.frombuffer(raw[80:84], "<u4")[0]
    corners: NDArray[np.float32] = rows["v"]
    outward = np.einsum("ni,ni->n", rows["n"], corners.mean(axis=1))
    assert (outward > 0).all()
    return corners


def _ply(path: Path) -> NDArray[np.float32]:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    assert b"comment splatline, lengths in mm" in head
    n, m = (int(found) for found in re.findall(rb"element \w+ (\d+)", head))
    places = np.frombuffer(body[: 12 * n], "<f4").reshape(n, 3)
    faces = np.frombuffer(body[12 * n :], np.dtype([("n", "u1"), ("at", "<i4", 3)]))
    assert len(faces) == m and (faces["n"] == 3).all()
    return places[faces["at"]]


def _obj(path: Path) -> NDArray[np.float32]:
    lines = path.read_text(encoding="ascii").splitlines()
    assert lines[0] == "# splatline, lengths in mm"
    places = np.array([line.split()[1:] for line in lines if line.startswith("v ")], np.float32)
    return places[np.array([line.split()[1:] for line in lines if line.startswith("f ")], int) - 1]


def test_the_three_formats_hold_the_same_closed_ball(ball: Path) -> None:
    meshes = []
    for suffix, read in ((".stl", _stl), (".ply", _ply), (".obj", _obj)):
        result = beamline("surface", "ball.npz", "-o", f"ball{suffix}")
        assert result.exit_code == 0, result.output
        assert "Euler number 2" in result.output
        meshes.append(read(ball / f"ball{suffix}"))
    for other in meshes[1:]:
        np.testing.assert_array_equal(other, meshes[0])
    radius = np.linalg.norm(meshes[0], axis=2)
    assert np.sqrt(np.mean((radius - 0.5) ** 2)) < 0.005
    a, b, c = np.moveaxis(meshes[0].astype(np.float64), 1, 0)
    share = np.einsum("ij,ij->", a, np.cross(b, c)) / 6 / (4 / 3 * np.pi * 0.5**3)
    assert 0.97 < share < 1  # chords of a ball of five voxels lie inside it


def test_vertices_of_gaussians_are_on_the_level_of_their_density(folder: Path) -> None:
    fit = ("-m", "r2", "--steps", "40", "--gaussians", "200", "--finish", "0", "--no-report", "-o", "v.h5")
    assert beamline("recon", "scan.h5", *fit).exit_code == 0
    result = beamline("surface", "v.h5", "--from", "gaussians", "--level", "0.02", "-o", "v.obj")
    assert result.exit_code == 0, result.output
    corners = _obj(folder / "v.obj").reshape(-1, 3).astype(np.float64)
    low, high = read_reconstruction(folder / "v.h5").volume.grid.edges
    inside = ((corners > low + 1e-3) & (corners < high - 1e-3)).all(axis=1)
    assert inside.mean() > 0.1
    density = density_at(read_model(folder / "v.h5").gaussians, corners[inside])[0]
    assert np.quantile(np.abs(density - 0.02), 0.95) < 1e-4


SURFACE_COMMAND_REFUSED = [
    (("--level", "7"), 5, "no value lies above the level 7"),
    (("--from", "gaussians"), 5, "ball.npz"),
    (("-o", "x.tif"), 2, "format of a mesh '.tif' is unknown"),
]


@pytest.mark.parametrize(("options", "code", "said"), SURFACE_COMMAND_REFUSED)
def test_what_has_no_surface_is_refused_and_nothing_is_left(
    ball: Path, options: tuple[str, ...], code: int, said: str
) -> None:
    result = beamline("surface", "ball.npz", "-o", "x.stl", *options)
    assert result.exit_code == code and said in result.output + str(result.exception)
    assert left(ball) == {"ball.npz"}
