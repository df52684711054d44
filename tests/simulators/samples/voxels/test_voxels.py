"""Voxels against closed forms: exact sums, ramps, a Gaussian, a sphere, means of blocks; and wrong volumes refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numba import config
from scipy.ndimage import map_coordinates

from recon.base.volume import Grid
from simulators.frame.shot import Detector, Pose
from simulators.samples.voxels.voxels import Voxels
from tests.refused_calls import refused_calls

SHAPE, SPACING = (7, 9, 11), (0.05, 0.04, 0.03)


@pytest.fixture
def random(rng: np.random.Generator) -> Voxels:
    return Voxels.of(rng.random(SHAPE), SPACING)


def _sampled(voxels: Voxels, pose: Pose, detector: Detector, n: int = 3000) -> np.ndarray:
    """Line integrals by many steps along each ray through scipy's interpolation: no plane, no main axis."""
    axes, origin = pose.frames()
    out = np.zeros(detector.shape)
    t = ((np.arange(n) + 0.5) / n - 0.5) * 1.2
    inner = voxels.padded[1:-1, 1:-1, 1:-1].astype(np.float64)
    for j, v in enumerate(detector.v()):
        for i, u in enumerate(detector.u()):
            through = origin[j] + u * axes[j, :, 0] + v * axes[j, :, 2]
            if math.isinf(detector.sod):
                along = axes[j, :, 1]
            else:
                along = through - (origin[j] - detector.sod * axes[j, :, 1])
                along /= np.linalg.norm(along)
            points = through[:, None] + t * along[:, None]
            place = [
                (points[2 - k] - voxels.first[k]) / voxels.spacing[k] for k in range(3)
            ]  # (z, y, x) from (x, y, z)
            out[j, i] = map_coordinates(inner, place, order=1, mode="grid-constant").sum() * 1.2 / n
    return out


POSES = {
    "upright": lambda pose: pose,
    "shifted": lambda pose: pose.shifted_by([0.02, 0.2, -0.03]),
    "tilted": lambda pose: pose.tilted_by([0.2, -0.15]).shifted_by([0.02, 0.0, 0.01]),
    "each row its own": lambda pose: pose.turned_by(np.linspace(0, 0.3, 6)).shifted_by(
        np.linspace(0, 0.03, 18).reshape(6, 3)
    ),
}


def _blob(spacing: tuple[float, float, float], shape: tuple[int, int, int]) -> Voxels:
    """A Gaussian: smooth, so that what is left is the interpolation's, which falls with the square of the voxel."""
    z, y, x = ((np.arange(n) - (n - 1) / 2) * step for n, step in zip(shape, spacing, strict=True))
    r2 = (x - 0.03) ** 2 + (y[:, None] + 0.02) ** 2 + (z[:, None, None] - 0.01) ** 2
    return Voxels.of(np.exp(-r2 / 2 / 0.05**2), spacing)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("sod", [math.inf, 0.9])
@pytest.mark.parametrize("angle", [0.3, 1.3, -2.6])
def test_line_integrals_are_those_of_the_interpolated_volume(pose: str, sod: float, angle: float) -> None:
    voxels = _blob((0.024, 0.02, 0.018), (31, 37, 41))
    detector = Detector((6, 5), 0.04, axis_col=2.3, axis_row=2.6, sod=sod)
    stands = POSES[pose](Pose.turned(angle, 6))
    expected = _sampled(voxels, stands, detector)
    # Joseph takes the planes only: between them the cells are trilinear, and curved by up to (h/σ)²/8 = 3 %.
    np.testing.assert_allclose(voxels.line_integrals(stands, detector), expected, atol=0.012 * expected.max())


@pytest.mark.parametrize("sod", [math.inf, 0.9])
def test_the_error_against_the_closed_form_falls_with_the_square_of_the_voxel(sod: float) -> None:
    """The integral of a Gaussian along a ray is √(2π) σ exp(-d²/2σ²), d being the ray's distance from its middle."""
    pose = Pose.turned(0.7, 8).tilted_by([0.1, 0.05])
    detector = Detector.centred((8, 8), 0.03, sod=sod)
    axes, _ = pose.frames()
    errors = []
    for n in (2, 4):
        voxels = _blob((0.048 / n,) * 3, (12 * n + 1,) * 3)
        point = axes[:, None, :, 0] * detector.u()[None, :, None] + axes[:, None, :, 2] * detector.v()[:, None, None]
        along = np.broadcast_to(axes[:, None, :, 1], point.shape)
        if not math.isinf(sod):
            along = point + sod * along
            along = along / np.linalg.norm(along, axis=2, keepdims=True)
        to = np.array([0.03, -0.02, 0.01]) - point
        d2 = (to**2).sum(2) - (to * along).sum(2) ** 2
        expected = math.sqrt(2 * math.pi) * 0.05 * np.exp(-d2 / 2 / 0.05**2)
        errors.append(np.abs(voxels.line_integrals(pose, detector) - expected).max())
    assert errors[1] < 0.01 * 0.125
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.25)


def test_truth_on_its_own_grid_is_the_volume_and_on_a_coarser_one_the_mean_of_blocks(random: Voxels) -> None:
    values = np.arange(4 * 6 * 8, dtype=float).reshape(4, 6, 8)
    voxels = Voxels.of(values, 0.1)
    np.testing.assert_array_equal(voxels.attenuation(Grid((4, 6, 8), 0.1)), values)
    blocks = values.reshape(2, 2, 3, 2, 4, 2).mean(axis=(1, 3, 5))
    np.testing.assert_allclose(voxels.attenuation(Grid((2, 3, 4), 0.2)), blocks, rtol=1e-6)
    # Anywhere else: trilinear, as scipy has it.
    grid = Grid((5, 6, 7), 0.02, (0.01, -0.02, 0.03))
    place = np.meshgrid(
        *((c - f) / s for c, f, s in zip(grid.coordinates(), random.first, SPACING, strict=True)), indexing="ij"
    )
    inner = random.padded[1:-1, 1:-1, 1:-1]
    expected = map_coordinates(inner, place, order=1, mode="grid-constant")
    np.testing.assert_allclose(random.attenuation(grid), expected, rtol=1e-5)


def test_labels_are_of_thresholds_or_of_the_nearest_voxel() -> None:
    values = np.zeros((3, 4, 5))
    values[1, 1:3, 1:4], values[1, 2, 2] = 1.0, 2.0
    grid = Grid((3, 4, 5), 0.1)
    plain = Voxels.of(values, 0.1)
    assert plain.names == ("matter",)
    np.testing.assert_array_equal(plain.labels(grid), values > 0)
    phases = Voxels.of(values, 0.1, thresholds=[0.5, 1.5])
    assert phases.names == ("phase_1", "phase_2")
    np.testing.assert_array_equal(phases.labels(grid), values)
    named = Voxels.of(values, 0.1, labels=values.astype(int), names=("tissue", "bone"))
    fine = named.labels(Grid((9, 12, 17), 0.1 / 3))  # a voxel wider than the volume on both sides along x
    np.testing.assert_array_equal(fine[:, :, 1:-1], values.repeat(3, 0).repeat(3, 1).repeat(3, 2))
    assert not fine[:, :, [0, -1]].any()


@pytest.mark.parametrize("spacing", [0.003, 1 / 3, (0.05, 0.04, 0.03)])
def test_no_voxel_takes_a_label_or_a_value_from_its_neighbour(
    rng: np.random.Generator, spacing: float | tuple[float, float, float]
) -> None:
    """On its own grid, however its coordinates are rounded; at a threshold, too."""
    values = rng.integers(0, 3, (5, 30, 30)).astype(np.float32)
    pitch, edge = (spacing[0], spacing[2]) if isinstance(spacing, tuple) else (spacing, spacing)
    if isinstance(spacing, tuple):
        spacing = (pitch, edge, edge)
    grid = Grid(values.shape, edge, slice_pitch=pitch)
    np.testing.assert_array_equal(Voxels.of(values, spacing).attenuation(grid), values)
    np.testing.assert_array_equal(Voxels.of(values, spacing).labels(grid), values > 0)
    np.testing.assert_array_equal(Voxels.of(values, spacing, thresholds=[1.0, 2.0]).labels(grid), values)


@pytest.mark.parametrize("sod", [math.inf, 1e5])
@pytest.mark.parametrize("shift", [1e6, 1e8])
def test_a_volume_far_from_its_rays_is_seen_by_none(sod: float, shift: float) -> None:
    """It is 1e15 voxels away, and a ray's place in it is known to several voxels only."""
    voxels, detector = Voxels.of(np.ones((3, 3, 3)), 1e-9), Detector((5, 70), 1e-6, 3.3, 1.0, sod)
    for moved in ((0.0, 1.0, shift), (shift, 1.0, 0.0)):
        for angle in (0.0, math.pi / 2):
            assert np.abs(voxels.line_integrals(Pose.turned(angle, 5).shifted_by(moved), detector)).max() < 1e-8


def test_the_radius_holds_all_matter() -> None:
    values = np.zeros((3, 21, 21))
    values[1, 10, 18] = 1.0
    voxels = Voxels.of(values, 0.1)
    # The voxel's centre is 0.8 mm out, and its interpolation ends one voxel further in x and y.
    assert voxels.radius == pytest.approx(math.hypot(0.9, 0.1))
    assert Voxels.of(np.zeros((2, 2, 2)), 0.1).radius == 0


def test_a_source_in_the_volume_is_refused(random: Voxels) -> None:
    """The volume with its rim is 10 x 12 voxels of 0.04 and 0.03 mm about the axis: its corner is 0.27 mm out."""
    detector = Detector.centred((3, 4), 0.05, sod=0.28)
    random.line_integrals(0.7, detector)
    for moved in (Pose.turned(0.7, 3).shifted_by([0.0, -0.03, 0.0]), Pose.turned(math.atan2(0.2, 0.18), 3)):
        close = Detector.centred((3, 4), 0.05, sod=0.265 if moved.shift is None else 0.28)
        with pytest.raises(ValueError, match=r"detector: increase sod"):
            random.line_integrals(moved, close)
    with pytest.raises(ValueError, match="2 angles"):
        random.line_integrals(Pose.turned(0.0, 2), detector)


def test_threads_change_nothing(random: Voxels, monkeypatch: pytest.MonkeyPatch) -> None:
    detector = Detector.centred((30, 20), 0.02)
    pose = Pose.turned(0.4, 30)
    for stands in (pose, pose.tilted_by([0.1, 0.1])):
        monkeypatch.setattr(config, "NUMBA_NUM_THREADS", 1)
        alone = random.line_integrals(stands, detector)
        monkeypatch.setattr(config, "NUMBA_NUM_THREADS", 3)
        np.testing.assert_array_equal(random.line_integrals(stands, detector), alone)
        assert alone.any()


test_calls_that_are_refused = refused_calls(__file__, globals())
