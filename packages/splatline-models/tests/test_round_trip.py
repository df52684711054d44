"""Round trip: the mesh from the scan of a sphere is that sphere."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np

from tests.beamline.cli.small_scan import succeeds


def test_a_sphere_comes_back_from_its_scan(tmp_path: Path) -> None:
    """Scan without noise, FBP, surface: the distance of its corners from the sphere, in voxels."""
    radius, pixel = 0.2, 0.01
    scene = (
        f"phantom: {{kind: solids, solids: [{{kind: ellipsoid, semi_axes: {[radius] * 3}, attenuation: 2.0}}]}}\n"
        "beam: {photons_per_s: 1.0e+5}\neffects: [pixel_area]\n"
        "detector: {shape: [56, 64], pixel_size_um: 10.0}\nscan: {views: 120, fly: false, darks: 1, flats: 1}\n"
    )
    (tmp_path / "scene.yaml").write_text(scene, "utf-8")
    for words in (
        ("simulate", "scene.yaml", "-o", "scan.h5"),
        ("recon", "scan.h5", "-m", "fbp", "--filter", "ram-lak", "--axis", "31.5", "-o", "out.h5"),
        ("surface", "out.h5", "-o", "found.ply"),
    ):
        succeeds(*(str(tmp_path / word) if "." in word and not word[0].isdigit() else word for word in words))
    off = (np.linalg.norm(meshio.read(tmp_path / "found.ply").points, axis=1) - radius) / pixel
    assert np.sqrt(np.mean(off**2)) < 0.1
