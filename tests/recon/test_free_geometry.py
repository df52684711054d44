"""Laminography and a cone with free sources, compared with ordinary projections of the same ellipsoid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import recon
from recon.base.geometry import Geometry
from recon.base.vectors import vectors_of
from recon.base.volume import Grid
from tests.recon.voxels.test_projector import ellipsoid_shadow, smooth_ball

AXES, CENTRE, GRID = np.array([0.42, 0.36, 0.2]), np.array([0.05, -0.08, 0.03]), Grid((16, 28, 28), 0.04)
TURN = np.arange(24) * 2 * np.pi / 24


def error(views: Geometry, told: Geometry) -> float:
    """Of FISTA-TV, relative; `told`: the geometry that it is given for the views."""
    data = ellipsoid_shadow(views, AXES, CENTRE).astype(np.float32)
    found = recon.reconstruct(data, told, recon.FistaTv(iterations=10, tv_weight=1e-3), grid=GRID).volume.data
    truth = smooth_ball(GRID, AXES, CENTRE)
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def test_free_views_are_reconstructed_about_as_well_as_plain_ones() -> None:
    parallel, cone = (
        Geometry.parallel(TURN, (20, 32), pixel_pitch=0.04),
        Geometry.cone(TURN, (20, 32), 0.08, 10.0, 20.0),
    )
    laminography = replace(parallel, tilt=np.full(len(TURN), np.radians(30)), detector_shape=(28, 32), axis_row=13.5)
    away = 0.3 * np.stack((np.cos(3 * TURN), np.sin(2 * TURN), np.sin(3 * TURN)), 1)
    free = replace(
        cone, shifts=2 * np.stack((np.sin(2 * TURN), np.cos(TURN)), 1), detector_shape=(30, 44), axis_col=21.5,
        axis_row=14.5, roll=0.1 * np.sin(TURN), tilt=0.2 * np.cos(2 * TURN), centres=away,
    )  # fmt: skip
    told = recon.geometry_of_vectors(vectors_of(free), free.detector_shape, cone=True)
    plain = error(cone, cone)
    assert error(free, told) < 1.1 * plain
    assert error(free, replace(told, centres=np.zeros((len(TURN), 3)))) > 2 * plain  # the sources matter
    assert error(laminography, laminography) < 1.5 * error(parallel, parallel)  # a cone of directions is missing
