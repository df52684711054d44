"""A round trip: meshes that meshio writes are read for scenes, and a sphere comes back from its scan."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.storage.meshes import read_mesh
from tests.beamline.cli.small_scan import succeeds
from tests.simulators.samples.voxels.test_files import sphere


def write_sphere(path: Path, corners: int, radius: float) -> np.ndarray:
    triangles = sphere(corners, radius)
    vertices, faces = np.unique(triangles.reshape(-1, 3).astype(np.float32), axis=0, return_inverse=True)
    meshio.Mesh(vertices, [("triangle", faces.reshape(-1, 3))]).write(
        path, **({} if path.suffix == ".obj" else {"binary": True})
    )
    return vertices[faces.reshape(-1, 3)]


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj"])
def test_what_is_written_is_read(tmp_path: Path, suffix: str) -> None:
    corners = write_sphere(tmp_path / f"ball{suffix}", 60, 0.2)
    np.testing.assert_allclose(read_mesh(tmp_path / f"ball{suffix}"), corners, rtol=1e-6, atol=1e-9)
    (tmp_path / f"cut{suffix}").write_bytes((tmp_path / f"ball{suffix}").read_bytes()[:-30])
    with pytest.raises(DataError, match="as a mesh"):
        read_mesh(tmp_path / f"cut{suffix}")


def test_a_sphere_comes_back_from_its_scan(tmp_path: Path) -> None:
    """Mesh, scan without noise, FBP, surface: the distance of its corners from the sphere, in voxels."""
    radius, pixel = 0.2, 0.01
    write_sphere(tmp_path / "ball.stl", 5000, radius)
    scene = (
        "phantom: {kind: mesh, file: ball.stl, attenuation: 2.0, voxel_mm: 0.005}\nbeam: {photons_per_s: 1.0e+5}\n"
        "detector: {shape: [56, 64], pixel_size_um: 10.0}\nscan: {views: 120, fly: false, darks: 1, flats: 1}\n"
    )
    (tmp_path / "scene.yaml").write_text(scene, "utf-8")
    for words in (
        ("simulate", "scene.yaml", "-o", "scan.h5"),
        ("recon", "scan.h5", "-m", "fbp", "--filter", "ram-lak", "--axis", "31.5", "-o", "out.h5"),
        ("surface", "out.h5", "-o", "found.ply"),
    ):
        succeeds(*(str(tmp_path / word) if "." in word and not word[0].isdigit() else word for word in words))
    off = (np.linalg.norm(read_mesh(tmp_path / "found.ply").reshape(-1, 3), axis=1) - radius) / pixel
    assert np.sqrt(np.mean(off**2)) < 0.1
