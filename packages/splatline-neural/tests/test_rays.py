"""The rays of a field meet the box at the same points as the projector's rays, for any geometry."""

from __future__ import annotations

import numpy as np
import pytest

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.projector import Projector
from splatline_neural.networks import drawn, rays_of

GRID = Grid((20, 32, 32), 0.25, (0.4, 0.2, -0.3))
ANGLES = np.array([0.0, 0.3, np.pi / 2, 2.0, 4.0])
LEAN = {"roll": 0.05 * np.cos(ANGLES), "tilt": 0.04 * np.sin(ANGLES), "shifts": np.stack((ANGLES / 3, -ANGLES / 4), 1)}
VIEWS = {
    "parallel": Geometry.parallel(ANGLES, (12, 20), pixel_pitch=0.4, axis_col=9.2),
    "skew": Geometry.parallel(ANGLES, (12, 20), pixel_pitch=0.4, axis_col=9.2).seen_with(
        Geometry.parallel([0], (1, 1)).width, 0.01
    ),
    "leaning": Geometry.parallel(ANGLES, (12, 20), pixel_pitch=0.4, axis_col=9.2, **LEAN),
    "cone": Geometry.cone(ANGLES, (12, 20), 0.6, 20.0, 30.0, axis_col=10.1, axis_row=5.0),
    "leaning cone": Geometry.cone(ANGLES, (12, 20), 0.6, 20.0, 30.0, axis_col=10.1, axis_row=5.0, **LEAN),
}


@pytest.mark.parametrize("kind", VIEWS)
def test_integrals_of_a_smooth_blob_are_those_of_the_projector(kind: str) -> None:
    """200 samples a ray against voxels of h = 0.4 widths w, whose interpolation errs by h² / 4 w² at most."""
    geometry, middle, width = VIEWS[kind], np.array([0.2, -0.5, 0.7]), 0.6
    z, y, x = np.meshgrid(*GRID.coordinates(), indexing="ij")
    blob = np.exp(-((x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2) / (2 * width**2))
    expected = Projector(geometry, GRID).forward(blob.astype(np.float32)).reshape(ANGLES.size, -1)
    low, high = GRID.edges
    edge = (high - low).max()
    places = (np.arange(200, dtype=np.float32) + 0.5) / 200
    for view in range(ANGLES.size):
        rays = rays_of(geometry, view, np.arange(240), GRID)
        points = rays.samples(places) * edge + low
        found = np.exp(-((points - middle) ** 2).sum(-1) / (2 * width**2)).mean(1) * rays.lengths * edge
        assert np.abs(found - expected[view]).max() < 0.045 * expected.max()


def test_a_ray_past_the_box_has_no_length_and_one_along_a_side_is_not_lost() -> None:
    geometry = Geometry.parallel([0.0], (1, 41), pixel_pitch=0.5)  # columns at -10 ... 10 mm
    grid = Grid((4, 8, 8), 1.0)
    lengths = rays_of(geometry, 0, np.arange(41), grid).lengths * 8
    across = (np.arange(41) - 20) * 0.5
    np.testing.assert_allclose(lengths[np.abs(across) < 4], 8)
    np.testing.assert_allclose(lengths[np.abs(across) > 4], 0)


def test_a_step_takes_windows_and_candidates_outside_of_them(rng: np.random.Generator) -> None:
    candidates = np.zeros((40, 50), bool)
    candidates[5:30, 10:40] = True
    plain = drawn(rng, candidates, 300, 0, 8)
    assert plain.size == 300 and candidates.reshape(-1)[plain].all()
    both = drawn(rng, candidates, 100, 3, 8)
    windows, others = both[:192].reshape(3, 8, 8), both[192:]
    assert (np.diff(windows, axis=1) == 50).all() and (np.diff(windows, axis=2) == 1).all()
    assert others.size == 100 and candidates.reshape(-1)[others].all() and not np.isin(others, windows).any()
    few = _first_row(candidates)
    assert drawn(rng, few, 300, 0, 8).size == few.sum()  # each once


def _first_row(candidates: np.ndarray) -> np.ndarray:
    few = candidates.copy()
    few[6:] = False
    return few
