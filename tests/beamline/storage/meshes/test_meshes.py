"""Meshes from files: those that we write, text by hand, and a round trip from a mesh by its scan to a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.core.errors import DataError
from beamline.features.models.command import write_mesh
from beamline.storage.meshes import read_mesh
from recon.features.surfaces import Mesh
from tests.simulators.samples.voxels.test_files import sphere

TEXT = {
    "a.stl": "solid a\n facet normal 0 0 1\n  outer loop\n   vertex 0 0 0\n   vertex 1 0 0\n   vertex 0 2 0\n"
    "  endloop\n endfacet\nendsolid a\n",
    "a.obj": "# text\nv 0 0 0\nv 1 0 0 \nv 0 2 0\nvn 0 0 1\nf 1//1 2//1 3//1\n",
    "b.obj": "v 0 0 0\nv 1 0 0\nv 0 2 0\nf -3 -2 -1\n",
    "a.ply": "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 2 0\n3 0 1 2\n",
}


@pytest.mark.parametrize("name", TEXT)
def test_text(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(TEXT[name], "utf-8")
    np.testing.assert_array_equal(read_mesh(tmp_path / name), [[[0, 0, 0], [1, 0, 0], [0, 2, 0]]])


def test_text_with_the_line_ends_of_windows(tmp_path: Path) -> None:
    for name, text in TEXT.items():
        (tmp_path / name).write_bytes(text.replace("\n", "\r\n").encode())
        np.testing.assert_array_equal(read_mesh(tmp_path / name), [[[0, 0, 0], [1, 0, 0], [0, 2, 0]]])


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("points.ply", TEXT["a.ply"].split("element face")[0] + "end_header\n0 0 0\n1 0 0\n0 2 0\n", "it has no faces"),
        ("head.ply", TEXT["a.ply"].split("end_header")[0], "its header does not end"),
        ("a.obj", TEXT["a.obj"].replace("1//1", "0//1"), "a corner before the first one"),
        ("a.obj", TEXT["a.obj"].replace("3//1", "3//1 1//1"), "expected three corners each"),
        ("a.obj", TEXT["a.obj"].replace("3//1", "4//1"), "out of bounds"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text, "utf-8")
    with pytest.raises(DataError, match=said):
        read_mesh(tmp_path / name)


def _indexed(triangles: np.ndarray) -> Mesh:
    vertices, faces = np.unique(triangles.reshape(-1, 3).astype(np.float32), axis=0, return_inverse=True)
    return Mesh(vertices, faces.reshape(-1, 3).astype(np.int32))


@pytest.mark.parametrize("suffix", [".stl", ".ply", ".obj"])
def test_what_we_write_is_read(tmp_path: Path, suffix: str) -> None:
    mesh = _indexed(sphere(60, 0.2))
    write_mesh(tmp_path / f"ball{suffix}", mesh, "mm")
    np.testing.assert_allclose(read_mesh(tmp_path / f"ball{suffix}"), mesh.vertices[mesh.faces], rtol=1e-7)
    (tmp_path / f"cut{suffix}").write_bytes((tmp_path / f"ball{suffix}").read_bytes()[:-30])
    with pytest.raises(DataError, match="as a mesh"):
        read_mesh(tmp_path / f"cut{suffix}")


def test_a_sphere_comes_back_from_its_scan(tmp_path: Path) -> None:
    """Mesh, scan without noise, FBP, surface: the distance of its corners from the sphere, in voxels."""
    radius, pixel = 0.2, 0.01
    write_mesh(tmp_path / "ball.stl", _indexed(sphere(5000, radius)), "mm")
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
        placed = [str(tmp_path / word) if "." in word and not word[0].isdigit() else word for word in words]
        done = CliRunner().invoke(main, placed)
        assert done.exit_code == 0, done.output
    found = read_mesh(tmp_path / "found.ply").reshape(-1, 3)
    off = (np.linalg.norm(found, axis=1) - radius) / pixel
    print(f"RMS {np.sqrt(np.mean(off**2)):.4f} voxels, mean {off.mean():+.4f}")
    assert np.sqrt(np.mean(off**2)) < 0.1
