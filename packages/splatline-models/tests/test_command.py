"""`beamline voxelise`, `render`, `surface`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.gaussians import read_model
from beamline.storage.writers.recon_file import read_reconstruction
from recon import Grid
from splatline_models.made import Mesh, half_way, surface, write_views
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


REFUSED = [
    (("voxelise", "f.h5", "-o", "x.h5"), 5, "contains no Gaussians"),
    (("render", "f.h5", "-o", "x.h5"), 5, "contains no Gaussians"),
    (("render", "f.h5", "-o", "x.tif"), 2, "projections are written as HDF5"),
    (("render", "f.h5", "-o", "x.h5", "--angles", "0:180:0"), 2, "expected angles FIRST:END:STEP"),
    (("render", "f.h5", "-o", "x.h5", "--angles", "nan"), 2, "expected angles FIRST:END:STEP"),
    (("voxelise", "f.h5", "-o", "x.h5", "--box", "0:1,0:1"), 2, "expected a box Z0:Z1"),
]


def test_a_volume_without_gaussians_and_bad_names_are_refused(folder: Path) -> None:
    _made("recon", "scan.h5", "-m", "fbp", "--no-report", "-o", "f.h5")
    for arguments, code, said in REFUSED:
        result = beamline(*arguments)
        assert result.exit_code == code and said in result.stderr + str(result.exception), (arguments, result.output)
        assert not list(folder.glob("x.*"))


def test_views_of_a_cone_are_refused(folder: Path) -> None:
    _made("recon", "scan.h5", *FIT, "-o", "v.h5")
    model = read_model(folder / "v.h5")
    with pytest.raises(DataError, match="of a cone"):
        write_views(
            folder / "x.h5", replace(model, geometry=replace(model.geometry, sod=100.0, sdd=250.0)), np.zeros(1), print
        )
    assert not list(folder.glob("x.*"))


@pytest.fixture
def ball(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A ball of radius 0.5 mm in voxels of 0.1 mm, as .npz, in the working folder."""
    monkeypatch.chdir(tmp_path)
    z, y, x = (np.indices((14, 14, 14)) - 6.5) * 0.1
    data = np.clip(0.5 - (np.sqrt(x * x + y * y + z * z) - 0.5) / 0.2, 0, 1).astype(np.float32)
    np.savez(tmp_path / "ball.npz", volume=data, voxel_mm=0.1)
    return tmp_path


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj"])
def test_a_mesh_is_the_closed_ball(ball: Path, suffix: str) -> None:
    result = beamline("surface", "ball.npz", "-o", f"ball{suffix}")
    assert result.exit_code == 0, result.output
    assert "Euler number 2" in result.output
    mesh = meshio.read(ball / f"ball{suffix}")
    corners = mesh.points[mesh.cells_dict["triangle"]].astype(np.float64)
    radius = np.linalg.norm(corners, axis=2)
    assert np.sqrt(np.mean((radius - 0.5) ** 2)) < 0.005
    a, b, c = np.moveaxis(corners, 1, 0)
    share = np.einsum("ij,ij->", a, np.cross(b, c)) / 6 / (4 / 3 * np.pi * 0.5**3)
    assert 0.97 < share < 1  # chords of a ball of five voxels lie inside it


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [(("--level", "7"), 5, "no value is above the level 7"), (("-o", "x.tif"), 2, "expected one of the suffixes .stl")],
)
def test_what_has_no_surface_is_refused_and_nothing_is_left(
    ball: Path, options: tuple[str, ...], code: int, said: str
) -> None:
    result = beamline("surface", "ball.npz", "-o", "x.stl", *options)
    assert result.exit_code == code and said in result.output + str(result.exception)
    assert left(ball) == {"ball.npz"}


def assert_closed(mesh: Mesh) -> None:
    """Each edge twice, once in each direction, and no two vertices in one place: as STL, too, it is closed."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    found, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 1).all()
    np.testing.assert_array_equal(found, np.unique(found[:, ::-1], axis=0))
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)


def test_noise_through_all_faces_is_closed() -> None:
    data = np.random.default_rng(0).normal(size=(17, 20, 23)).astype(np.float32)
    data[3:6, 4, 5] = 0.1  # on the level itself
    grid = Grid(data.shape, 1.0, slice_pitch=2.0)
    mesh = surface(data, grid, 0.1)
    assert_closed(mesh)
    low, high = grid.edges
    assert (mesh.vertices >= low).all() and (mesh.vertices <= high).all()


def test_a_full_box_is_closed_at_its_faces() -> None:
    mesh = surface(np.ones((3, 4, 5), np.float32), Grid((3, 4, 5)), 0.5)
    assert_closed(mesh)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), (5, 4, 3), rtol=2e-3)
    assert mesh.euler == 2


def test_neither_a_speck_of_metal_nor_a_small_body_in_empty_air_misleads_the_level() -> None:
    data = np.zeros((20, 40, 40), np.float32)
    data[:, 10:30, 10:30] = 1.0
    data[9:11, 19:21, 19:21] = 50.0
    assert half_way(data) == 0.5
    alone = np.zeros((20, 40, 40), np.float32)
    alone[8:12, 18:22, 18:22] = 1.0
    assert half_way(alone) == 0.5
