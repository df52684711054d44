"""The file between a trade-off and its trials: what went in comes out."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from beamline.features.trials.launch import TrialData, write_reference, write_regions
from recon.base.geometry import Geometry
from recon.base.method import Energies
from recon.prep.counts import Emission
from tests.beamline.prepared_views import prepared_views


def test_values_survive_the_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    views = Geometry.cone(
        rng.random(9), (40, 60), 0.5, 60.0, 120.0, shifts=rng.random((9, 2)), roll=0.1, tilt=rng.random(9)
    )
    images = rng.random((9, 40, 60)).astype(np.float32)
    whole = prepared_views(images, views, weights=images / 2)
    energies = Energies(np.arange(9), rng.random((9, 2)))
    whole = replace(whole, emission=Emission(images, views, survival=images), energies=energies, stretch=1.5)
    prepared = replace(whole.of_views(np.arange(3)), held_out=(images[3:], views.select(range(3, 9))))
    TrialData(prepared, images, np.arange(6.0)).save(tmp_path / "data")
    write_reference(tmp_path / "data", "os-sirt-tv", images[:1])
    write_regions(tmp_path / "data", np.ones((1, 2, 3), np.int8))
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
    np.testing.assert_array_equal(back.references["os-sirt-tv"], images[:1])
    assert back.regions is not None and back.regions.shape == (1, 2, 3) and list(back.references) == ["os-sirt-tv"]
    assert back.prepared.emission is not None and back.prepared.emission.background is None
    np.testing.assert_array_equal(back.prepared.emission.survival, images[:3])
    assert back.prepared.energies is not None and back.prepared.energies.of_view.tolist() == [0, 1, 2]
    for name in ("stretch", "length_unit", "n_projections", "axis_col"):
        assert getattr(back.prepared, name) == getattr(prepared, name)
    assert isinstance(back.prepared.projections.data, np.memmap)


def test_without_truth_and_views_held_out(tmp_path: Path) -> None:
    views = Geometry.parallel(np.arange(3.0), (2, 4))
    TrialData(prepared_views(np.zeros((3, 2, 4), np.float32), views), None).save(tmp_path / "data")
    back = TrialData.load(tmp_path / "data")
    assert (back.truth, back.regions, back.references, back.prepared.held_out) == (None, None, {}, None)
    assert back.prepared.emission is None and back.prepared.energies is None
