"""The file between a trade-off and its trials: what went in comes out."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np

from beamline.features.trials.data import TrialData, geometry_in
from recon.base.geometry import Geometry


def test_arrays_survive_the_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    views = Geometry.cone(
        rng.random(5), (4, 6), 0.5, 60.0, 120.0, shifts=rng.random((5, 2)), roll=0.1, tilt=rng.random(5)
    )
    images = rng.random((5, 4, 6)).astype(np.float32)
    data = TrialData(images[:3], views.select([0, 1, 2]), (images[3:], views.select([3, 4])), images, images / 2)
    data.save(tmp_path / "data")
    back = TrialData.load(tmp_path / "data")
    assert data.held_out is not None and back.held_out is not None
    for one, other in ((back.geometry, data.geometry), (back.held_out[1], data.held_out[1])):
        for f in fields(Geometry):
            np.testing.assert_array_equal(getattr(one, f.name), getattr(other, f.name))
    np.testing.assert_array_equal(back.projections, data.projections)
    np.testing.assert_array_equal(back.held_out[0], data.held_out[0])
    np.testing.assert_array_equal(back.truth, data.truth)
    np.testing.assert_array_equal(back.weights, data.weights)
    TrialData(data.projections, data.geometry, None, None).save(tmp_path / "bare")
    bare = TrialData.load(tmp_path / "bare")
    assert bare.held_out is None and bare.truth is None and bare.weights is None


def test_the_geometry_comes_without_the_views(tmp_path: Path) -> None:
    views = Geometry.parallel([0.0, 1.0], (4, 6), pixel_pitch=0.5, axis_col=2.2)
    TrialData(np.zeros((2, 4, 6), np.float32), views, None, None).save(tmp_path / "data")
    found = geometry_in(tmp_path / "data")
    assert (found.detector_shape, found.axis_col, found.is_cone) == ((4, 6), 2.2, False)
    np.testing.assert_array_equal(found.angles, views.angles)
