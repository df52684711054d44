"""The file between a trade-off and its trials: what went in comes out."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from beamline.features.trials.data import TrialData
from recon.base.geometry import Geometry
from tests.beamline.prepared_views import prepared_views


def test_values_survive_the_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    views = Geometry.cone(
        rng.random(9), (40, 60), 0.5, 60.0, 120.0, shifts=rng.random((9, 2)), roll=0.1, tilt=rng.random(9)
    )
    images = rng.random((9, 40, 60)).astype(np.float32)
    whole = prepared_views(images, views, weights=images / 2)
    prepared = replace(whole.of_views(np.arange(3)), held_out=(images[3:], views.select(range(3, 9))))
    TrialData(prepared, images, np.arange(6.0)).save(tmp_path / "data")
    back = TrialData.load(tmp_path / "data")
    assert prepared.held_out is not None and back.prepared.held_out is not None
    for one, other in ((back.geometry, prepared.geometry), (back.prepared.held_out[1], prepared.held_out[1])):
        for f in fields(Geometry):
            np.testing.assert_array_equal(getattr(one, f.name), getattr(other, f.name))
    np.testing.assert_array_equal(back.prepared.projections.data, images[:3])
    np.testing.assert_array_equal(back.prepared.projections.weights, images[:3] / 2)
    np.testing.assert_array_equal(back.prepared.held_out[0], images[3:])
    np.testing.assert_array_equal(back.truth, images)
    np.testing.assert_array_equal(back.shown_held_out, np.arange(6.0))
    assert back.references == {} and isinstance(back.prepared.projections.data, np.memmap)
