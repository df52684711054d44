"""The picture of a state while it is scanned: it shows an opened crack, from fewer projections than FBP alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.base.arrays import F32
from recon.base.view_data import Views
from recon.base.volume import Volume
from recon.features.reference.methods import FromReference
from tests.recon.features.reference.scene import LEVEL, Discs, N, packed, psnr, scanned

BEFORE = packed()
AFTER = replace(BEFORE, turn=np.radians(1.0), shift=(1.8, -1.1), slit=4)
VIEWS = 20


@pytest.fixture(scope="module")
def before() -> Volume:
    data, geometry = scanned(BEFORE, 180, 1e5)
    return recon.reconstruct(data, geometry, recon.FistaTv()).volume


def crack(volume: F32) -> float:
    """Depth of the slit: 1 in the truth."""
    gap = replace(AFTER, slit=-1).volume - AFTER.volume
    return float(((replace(AFTER, slit=-1).volume - volume) * gap).sum() / np.square(gap).sum())


def contrast(volume: F32) -> float:
    """Contrast of the slit with its particle, divided by the standard deviation of the other particles."""
    truth, gap = AFTER.volume, replace(AFTER, slit=-1).volume - AFTER.volume
    dy, dx = AFTER.at[AFTER.slit]
    at = np.arange(N) - (N - 1) / 2
    turned = np.cos(AFTER.turn), np.sin(AFTER.turn)
    y, x = turned[0] * dy + turned[1] * dx + AFTER.shift[0], turned[0] * dx - turned[1] * dy + AFTER.shift[1]
    inside = np.hypot(*np.meshgrid(at - y, at - x, indexing="ij")) < AFTER.radius[AFTER.slit] - 1.5
    slit, rest = (gap > 0.6 * LEVEL) & inside, (gap == 0) & inside
    others = (truth > 0.85 * LEVEL) & ~inside
    return float((volume[rest].mean() - volume[slit].mean()) / (volume - truth)[others].std())


def test_an_opened_crack_stands_out_where_fbp_alone_has_streaks(before: Volume) -> None:
    data, geometry = scanned(AFTER, VIEWS, 1e4, seed=2)
    shown = FromReference(before).preview(Views(data, geometry))
    assert shown is not None
    alone = recon.reconstruct(data, geometry, recon.Fbp()).volume.data
    assert psnr(shown.volume.data, AFTER.volume) > psnr(alone, AFTER.volume) + 6
    many = recon.reconstruct(*scanned(AFTER, 180, 1e5), recon.Fbp()).volume.data
    assert crack(shown.volume.data) > 0.85 * crack(many) and crack(shown.moved.data) < 0.2
    assert contrast(shown.volume.data) > 2 * contrast(alone)
    assert shown.left < 0.1


def test_the_reference_of_another_sample_leaves_more(before: Volume) -> None:
    ours, other = (scanned(scene, VIEWS, 1e4) for scene in (AFTER, packed(seed=9)))
    left = []
    for data, geometry in (ours, other):
        shown = FromReference(before).preview(Views(data, geometry))
        assert shown is not None
        left.append(shown.left)
    assert left[1] > 2 * left[0]


def test_there_is_no_picture_without_enough_projections_or_a_reference(before: Volume) -> None:
    data, geometry = scanned(AFTER, 12, 1e4)
    assert FromReference(before).preview(Views(data, geometry)) is None
    assert FromReference().preview(Views(*scanned(AFTER, VIEWS, 1e4))) is None
    assert recon.FistaTv().preview(Views(data, geometry)) is None
    empty = Volume(np.zeros_like(before.data), before.grid)
    assert FromReference(empty).preview(Views(*scanned(AFTER, VIEWS, 1e4))) is None
    above = Volume(before.data, replace(before.grid, centre=(1e4, 0.0, 0.0)))
    assert FromReference(above).preview(Views(*scanned(AFTER, VIEWS, 1e4))) is None
    cone = recon.Geometry.cone(np.arange(20.0), (4, N), pixel_pitch=1.0, sod=500.0, sdd=700.0)
    assert FromReference(before).preview(Views(np.ones((20, 4, N), np.float32), cone)) is None


def test_discs_of_the_scene_are_where_the_contrast_is_measured() -> None:
    scene: Discs = AFTER
    noise = np.random.default_rng(0).normal(0, 0.1 * LEVEL, scene.volume.shape).astype(np.float32)
    assert contrast(scene.volume + noise) > 3
