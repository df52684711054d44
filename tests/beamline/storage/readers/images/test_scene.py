"""A scene of R²-Gaussian, projected with its authors' geometry, gives their volume and not its mirror image."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recon
from beamline.core.errors import DataError
from beamline.storage.readers.open import open_scan
from recon.base.geometry import Geometry

DSO, DSD, N, PITCH = 7.0, 9.0, 20, 0.16
ANGLES = 0.3 + np.linspace(0, 2 * np.pi, 24, endpoint=False)
BALLS = np.array([[0.4, 0.1, 0.3, 0.3, 1.0], [-0.1, 0.5, -0.35, 0.3, 1.5]])  # x, y, z, radius, μ


def _projections() -> np.ndarray:
    """Chords of balls, as `angle2pose` of the authors has camera and detector: columns grow along (-sin θ, cos θ, 0),
    rows downwards along z."""
    views = []
    along = (np.arange(N) - (N - 1) / 2) * PITCH
    for angle in ANGLES:
        to_source, across = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
        pixels = -(DSD - DSO) * to_source + along[None, :, None] * across - along[:, None, None] * np.array([0, 0, 1])
        rays = pixels - DSO * to_source
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        depth = np.zeros((N, N))
        for x, y, z, radius, attenuation in BALLS:
            centre = np.array([x, y, z]) - DSO * to_source
            aside = centre @ centre - (rays @ centre) ** 2
            depth += 2 * attenuation * np.sqrt(np.clip(radius**2 - aside, 0, None))
        views.append(depth)
    return np.array(views, np.float32)


def _volume() -> np.ndarray:
    """vol_gt [x, y, z] on voxels as fine as ours, which are of a pixel at the axis."""
    side = (np.arange(N) - (N - 1) / 2) * PITCH * DSO / DSD
    x, y, z = np.meshgrid(side, side, side, indexing="ij")
    return sum(m * ((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 <= r**2) for a, b, c, r, m in BALLS)


def _scene(folder: Path, **changed: Any) -> Path:
    (folder / "proj_train").mkdir(parents=True)
    names = [f"proj_train/proj_train_{i:04d}.npy" for i in range(len(ANGLES))]
    for name, view in zip(names, _projections(), strict=True):
        np.save(folder / name, view)
    views = [{"file_path": name, "angle": angle} for name, angle in zip(names, ANGLES.tolist(), strict=True)]
    scanner = {"mode": "cone", "DSO": DSO, "DSD": DSD, "nDetector": [N, N], "sDetector": [N * PITCH] * 2}
    meta = {"scanner": scanner | {"offDetector": [0, 0], "offOrigin": [0, 0, 0]} | changed, "proj_train": views}
    (folder / "meta_data.json").write_text(json.dumps(meta | {"proj_test": views[:2]}))
    return folder


def test_a_scene_gives_the_volume_of_its_authors(tmp_path: Path) -> None:
    with open_scan(_scene(tmp_path / "scene")) as source:
        assert (source.quantity, source.cone, source.axis_col) == ("line_integrals", (DSO, DSD), (N - 1) / 2)
        assert source.pixel_size_mm == pytest.approx(PITCH)
        assert [field[:2] for field in source.not_used] == [("proj_test", "2 views")]
        views, angles = source.read(slice(None)), source.table.angles
    geometry = Geometry.cone(angles, (N, N), sod=DSO, sdd=DSD, pixel_pitch=PITCH)
    ours = recon.reconstruct(views, geometry, "fbp").volume.data
    theirs = _volume().transpose(2, 0, 1)[::-1, ::-1]
    alike = {at: np.corrcoef(ours.ravel(), np.flip(theirs, at).ravel())[0, 1] for at in ((), 0, 1, 2)}
    assert alike.pop(()) > 0.85 > 1.5 * max(alike.values())


@pytest.mark.parametrize(
    ("changed", "message"),
    [({"mode": "helical"}, "mode 'helical'; expected cone or parallel"), ({}, "1 of the files do not exist")],
)
def test_what_no_scene_has_is_refused(tmp_path: Path, changed: dict[str, Any], message: str) -> None:
    scene = _scene(tmp_path / "scene", **changed)
    (scene / "proj_train" / "proj_train_0003.npy").unlink()
    with pytest.raises(DataError, match=message):
        open_scan(scene / "meta_data.json")


def test_a_detector_that_is_not_centred_is_told(tmp_path: Path) -> None:
    with open_scan(_scene(tmp_path / "s", offDetector=[0.2, 0], mode="parallel")) as source:
        assert source.cone is None and source.axis_col is None
        assert any(field.where == "scanner/offDetector" and field.doubt for field in source.not_used)
