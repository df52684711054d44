"""`beamline surface`: meshes of voxels and of Gaussians, read back by readers of these tests, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.gaussians.model import read_model
from beamline.storage.writers.recon_file import read_reconstruction
from recon.features.surfaces.marching import density_at
from tests.beamline.cli.small_scan import beamline, left

pytest.importorskip("skimage")
pytestmark = pytest.mark.usefixtures("one_thread")


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


REFUSED = [
    (("--level", "7"), 5, "no value lies above the level 7"),
    (("--from", "gaussians"), 5, "ball.npz"),
    (("-o", "x.tif"), 2, "format of a mesh '.tif' is unknown"),
]


@pytest.mark.parametrize(("options", "code", "said"), REFUSED)
def test_what_has_no_surface_is_refused_and_nothing_is_left(
    ball: Path, options: tuple[str, ...], code: int, said: str
) -> None:
    result = beamline("surface", "ball.npz", "-o", "x.stl", *options)
    assert result.exit_code == code and said in result.output + str(result.exception)
    assert left(ball) == {"ball.npz"}
