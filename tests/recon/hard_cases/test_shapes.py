"""Gaussians of difficult shape: needles, discs, dots, giants, singular covariances, quaternions without a length."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from recon.base.kernel import RayModel, Truncation
from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from recon.splatting.splat import project, voxelize
from tests.recon.hard_cases.measure import RECURRENCE, STEP, bound, compare, directional, gradient_bound
from tests.recon.helpers import as_leaves, gradients

SHAPE, PITCH = (24, 30), 0.5
ANGLES = (0.3, 0.7, 2.5, -4.0)
BEAMS = {
    "parallel": Geometry.parallel(ANGLES, SHAPE, pixel_pitch=PITCH, axis_col=13.3),
    "leaning": Geometry.parallel(
        ANGLES, SHAPE, pixel_pitch=PITCH, axis_col=13.3, axis_row=10.0, roll=(0.2, -0.1, 0.0, 0.05), tilt=-0.3
    ),
    "cone": Geometry.cone(ANGLES, SHAPE, 0.8, 25.0, 40.0, axis_col=13.3).about(
        [(0.5, -0.3, 0.4), (-0.4, 0.2, 0.1), (0.0, 0.0, 0.0), (0.1, 0.6, -0.5)]
    ),
}
GRID = Grid((9, 12, 20), 0.6, centre=(0.4, -0.8, 1.1))
FAR = 40.0  # px: no pixel is farther from the middle of the detector, or from a centre in it
Shape = tuple[float, float, float]


def some(shape: Shape, n: int = 12, extent: float = 4.0, seed: int = 1, *, rounded: float = 0.0) -> Gaussians:
    """n Gaussians of one shape, in any orientation; `rounded` puts centres on a lattice of that pitch."""
    rng = np.random.default_rng(seed)
    means = (rng.random((n, 3)) - 0.5) * extent
    if rounded:
        means = np.round(means / rounded) * rounded
    return Gaussians.from_physical(
        means, np.tile(shape, (n, 1)), rng.uniform(0.2, 1, n), rng.normal(size=(n, 4)), density_unit=0.7
    )


@pytest.mark.parametrize("beam", BEAMS)
@pytest.mark.parametrize("aspect", [10.0, 1e2, 1e3, 1e4])
def test_a_needle_as_wide_as_a_pixel_keeps_its_digits_at_any_length(beam: str, aspect: float) -> None:
    thin = 0.5 if beam != "cone" else 0.4
    found = compare(some((thin, thin, min(thin * aspect, 5e3 if beam != "cone" else 20.0))), BEAMS[beam])
    assert found.value < bound(FAR, thin / PITCH)
    assert found.worst < gradient_bound(FAR, thin / PITCH), found.gradients


@pytest.mark.parametrize("aspect", [10.0, 1e2, 1e3, 1e4])
def test_a_needle_in_voxels_keeps_its_digits_at_any_length(aspect: float) -> None:
    found = compare(some((0.5, 0.5, 0.5 * aspect)), GRID)
    assert found.value < bound(15.0, 0.5)
    assert found.worst < gradient_bound(15.0, 0.5), found.gradients


@pytest.mark.parametrize("beam", BEAMS)
@pytest.mark.parametrize("aspect", [1e2, 1e3, 1e4])
def test_a_needle_thinner_than_a_pixel_is_as_exact_as_its_position(beam: str, aspect: float) -> None:
    # 10 px long and down to 1e-3 px wide: what is lost is a position's rounding over that width.
    thin = 5 / aspect
    found = compare(some((thin, thin, 5.0), 20), BEAMS[beam])
    assert found.value < bound(FAR, thin / PITCH)
    assert found.worst < gradient_bound(FAR, thin / PITCH), found.gradients


def test_gradients_of_a_needle_are_accurate_only_in_its_own_directions() -> None:
    # The gradient on the logarithm of a width, in float32, of slanted needles 0.05 px wide and longer than the image:
    # from ∂Σ₂ = 1/2 W K M₂ K with moments of δ, and from those of (τ, δv). The former is a small difference of numbers
    # aspect² as large, with the aspect that the image shows of it.
    long, thin = 500.0, 0.05
    rows, cols = np.mgrid[-30:31, -30:31].astype(np.float64)
    noise = np.random.default_rng(0).normal(size=rows.shape)

    def found(turn: float) -> tuple[float, float, float]:
        c, s = math.cos(turn), math.sin(turn)
        axes = np.array([[c, -s], [s, c]]) * (long, thin)  # a, b in the needle's own directions
        uu, uv, vv = axes[0] @ axes[0], axes[0] @ axes[1], axes[1] @ axes[1]
        white = (cols * -s + rows * c) / thin
        g = (noise * np.exp(-0.5 * (white**2 + ((cols * c + rows * s) / long) ** 2))).astype(np.float32)
        shape, k = axes.astype(np.float32), (np.array([[vv, -uv], [-uv, uu]]) / (long * thin) ** 2).astype(np.float32)
        delta = np.stack((cols, rows), -1).astype(np.float32)
        moments = np.einsum("rc,rci,rcj->ij", g, delta, delta)
        naive = (k @ moments @ k @ shape)[:, 1] @ shape[:, 1]
        own = np.stack((cols - uv / vv * rows, rows), -1).astype(np.float32)
        moments = np.einsum("rc,rci,rcj->ij", g, own, own)
        across = np.array([-s / thin, c * thin / vv]).astype(np.float32)  # A and B on the short axis
        return float(naive), float(across @ moments @ across), float((g.astype(np.float64) * white**2).sum())

    naive, ours, exact = np.array([found(turn) for turn in np.linspace(0.1, 1.4, 20)]).T
    assert np.abs(naive - exact).max() > 5e-3 * np.abs(exact).max()
    assert np.abs(ours - exact).max() < 2e-5 * np.abs(exact).max()


@pytest.mark.parametrize(("shape", "where"), [((0.5, 0.5, 50.0), "parallel"), ((2.0, 2.0, 2e-2), "cone")])
def test_the_reference_gradients_of_needles_and_discs_are_its_differences(shape: Shape, where: str) -> None:
    thin = min(shape) / max(shape)
    steps = {"means": 0.1 * min(shape), "log_scales": 0.1, "quaternions": 0.1 * thin, "raw_densities": 0.1}
    slope, difference = directional(some(shape, 5), BEAMS[where], steps)
    assert slope == pytest.approx(difference, rel=1e-5)


@pytest.mark.parametrize("thin", [2e-2, 2e-4, 2e-6])
@pytest.mark.parametrize("beam", BEAMS)
def test_flat_discs_at_any_angle(beam: str, thin: float) -> None:
    # No view meets any of these edge-on, so their pictures are wide in both directions.
    found = compare(some((2.0, 2.0, thin), 20), BEAMS[beam])
    narrowest = 0.1
    assert found.value < bound(FAR, narrowest)
    assert found.worst < gradient_bound(FAR, narrowest), found.gradients


@pytest.mark.parametrize("edge_on", [True, False])
def test_a_flat_disc_seen_edge_on_and_face_on(edge_on: bool) -> None:
    # Thin along x: at 0 degrees a line 0.002 px wide through the middle of a column, at 90 degrees a round spot.
    view = Geometry.parallel([0.0 if edge_on else math.pi / 2], (25, 31), pixel_pitch=PITCH)
    g = Gaussians.from_physical([[0.0, 0.0, 0.0]], [[1e-3, 2.0, 2.0]], [0.8])
    found = compare(g, view)
    assert found.value < bound(FAR, 1e-3 / PITCH if edge_on else 2.0 / PITCH)
    assert float(found.image.max()) == pytest.approx(
        0.8 * math.sqrt(2 * math.pi) * (2.0 if edge_on else 1e-3), rel=1e-5
    )
    torque = found.gradients.pop("quaternions")
    assert found.worst < gradient_bound(FAR, 1e-3 / PITCH if edge_on else 2.0 / PITCH), found.gradients
    if edge_on:
        assert torque < gradient_bound(FAR, 1e-3 / PITCH)
    else:
        # By symmetry there is none. A rotation's rounding tilts the disc, and a tilt of ε makes it aspect² ε thicker.
        size = float(found.slopes["log_scales"].abs().max())
        assert float(found.slopes["quaternions"].abs().max()) < 2e3**2 * STEP * size


@pytest.mark.parametrize("sigma", [0.2, 0.05, 1e-2, 1e-3])
def test_dots_smaller_than_a_pixel(sigma: float) -> None:
    # On the lattice of the pixels, and off it by half a standard deviation: else no pixel sees the small ones.
    view = Geometry.parallel([0.0], (25, 31), pixel_pitch=1.0)
    g = some((sigma,) * 3, 40, 10.0, rounded=1.0)
    moved = Gaussians(g.means + 0.5 * sigma, g.log_scales, torch.tensor([[1.0, 0, 0, 0]]).repeat(40, 1),
                      g.raw_densities, g.density_unit)  # fmt: skip
    found = compare(moved, view)
    assert found.value < bound(20.0, sigma)
    del found.gradients["quaternions"]  # round Gaussians: they are zero, see below
    assert found.worst < gradient_bound(20.0, sigma), found.gradients
    voxels = compare(moved, Grid((25, 31, 31)))
    assert voxels.value < bound(20.0, sigma)


@pytest.mark.parametrize("sigma", [1e-6, 1e-12, 1e-14, 1e-15])
@pytest.mark.parametrize("pitch", [1e-3, 1.0, 1e3])
def test_dots_of_any_size_where_a_position_can_be_as_fine(sigma: float, pitch: float) -> None:
    # Only around 0 does float32 hold places a part of these σ (px) apart: the product of three of them is below its
    # range from 1e-13 px on, with µm in mm from 1e-10 px.
    view = Geometry.parallel([0.0], (5, 7), pixel_pitch=pitch, axis_col=0.0, axis_row=0.0)
    length = sigma * pitch
    off, rng = np.array([0.6, 0.0, -0.4]) * length, np.random.default_rng(0)
    shape, turn = np.array([[2.0, 1.0, 1.5]]) * length, rng.normal(size=(1, 4))
    found = compare(Gaussians.from_physical(off[None], shape, [0.8 / length], turn, 1.0), view)
    assert found.image[0, 0, 0] > 0.5
    assert found.value < bound(0.0, 1.0) and found.worst < gradient_bound(0.0, 1.0), found.gradients


def test_a_turned_ball_feels_no_torque() -> None:
    # The off-diagonal part of T times (s_k / s_j - s_j / s_k): rounding of the scales' exponentials is all there is.
    found = compare(some((0.8,) * 3), BEAMS["parallel"])
    size = float(found.slopes["log_scales"].abs().max())
    assert float(found.slopes["quaternions"].abs().max()) < 20 * STEP * size


@pytest.mark.parametrize("sigma", [50.0, 1e3, 1e5, 1e7])
@pytest.mark.parametrize("beam", ["parallel", "leaning"])
def test_gaussians_larger_than_the_field(beam: str, sigma: float) -> None:
    found = compare(some((sigma, 1.3 * sigma, 0.7 * sigma)), BEAMS[beam])
    assert found.value < bound(FAR, sigma / PITCH)
    assert found.worst < gradient_bound(FAR, sigma / PITCH), found.gradients
    voxels = compare(some((sigma, 1.3 * sigma, 0.7 * sigma)), GRID)
    assert voxels.value < bound(FAR, sigma) and voxels.worst < gradient_bound(FAR, sigma)


@pytest.mark.parametrize(
    "shape",
    [
        (1e-15, 1e-15, 1e-15),
        (1e15, 1e15, 1e15),
        (1e-12, 1e-12, 1e-12),
        (1e-10, 1.0, 1.0),
        (1e-10, 1e-10, 1.0),
        (1e-8, 1.0, 1e8),
        (1e-12, 1e-12, 1e12),
    ],
)
@pytest.mark.parametrize("where", [*BEAMS, "voxels"])
def test_a_covariance_that_is_singular_to_rounding_is_finite(shape: Shape, where: str) -> None:
    # Σ₂ in float32 has no inverse here: its determinant is a difference of equal numbers, zero or negative.
    g = as_leaves(some(shape, 6, rounded=PITCH))
    image = voxelize(g, GRID) if where == "voxels" else project(g, BEAMS[where])
    assert torch.isfinite(image).all() and float(image.detach().min()) >= 0
    assert float(image.detach().max()) <= 12 * math.sqrt(2 * math.pi) * max(shape)
    image.sum().backward()
    assert all(torch.isfinite(slope).all() for slope in gradients(g).values())


def test_the_naive_determinant_of_a_needle_is_noise() -> None:
    a, b = (np.float32([4e2 * math.cos(t), 4e2 * math.sin(t)]) for t in (0.6, 0.6 + 1e-5))
    uu, uv, vv = a @ a, a @ b, b @ b
    exact = (4e2**2 * math.sin(1e-5)) ** 2
    assert abs(float(uu * vv - uv * uv) / exact - 1) > 0.5


@pytest.mark.parametrize("length", [1e-11, 1e-6, 1e6, 1e18, 1e30])
def test_quaternions_of_any_length_give_the_same_picture(length: float) -> None:
    g = some((0.4, 0.9, 1.7))
    scaled = Gaussians(g.means, g.log_scales, g.quaternions * length, g.raw_densities, g.density_unit)
    found, expected = compare(scaled, BEAMS["leaning"]), project(g, BEAMS["leaning"], truncation=Truncation(9.0, 1e-12))
    np.testing.assert_allclose(found.image, expected, atol=1e-5 * float(expected.max()))
    assert found.worst < gradient_bound(FAR, 0.8), found.gradients


@pytest.mark.parametrize("length", [0.0, 1e-30])
def test_a_quaternion_of_no_length_is_no_rotation_and_feels_nothing(length: float) -> None:
    assert np.float32(length) * np.float32(length) == 0  # naive: the rotation is 0 / 0
    g = some((0.4, 0.9, 1.7))
    quaternions = torch.zeros_like(g.quaternions)
    quaternions[:, 2] = length
    still = as_leaves(Gaussians(g.means, g.log_scales, quaternions, g.raw_densities, g.density_unit))
    plain = Gaussians(
        g.means, g.log_scales, torch.tensor([[1.0, 0, 0, 0]]).repeat(12, 1), g.raw_densities, g.density_unit
    )
    image = project(still, BEAMS["parallel"])
    np.testing.assert_array_equal(image.detach(), project(plain, BEAMS["parallel"]))
    image.sum().backward()
    assert not gradients(still)["quaternions"].any()
    assert all(torch.isfinite(slope).all() for slope in gradients(still).values())


exponents = st.floats(-4, 4)


@settings(max_examples=60)
@given(
    shape=st.tuples(exponents, exponents, exponents),
    turn=st.tuples(*(st.floats(-1, 1),) * 4).filter(lambda q: sum(x * x for x in q) > 1e-6),
    centre=st.tuples(*(st.floats(-8, 8),) * 3),
    where=st.sampled_from([*BEAMS, "exact rays", "voxels"]),
)
def test_any_shape_is_within_its_bound(
    shape: Shape, turn: tuple[float, ...], centre: tuple[float, ...], where: str
) -> None:
    scales = 10 ** np.array(shape)
    g = Gaussians.from_physical([centre], [scales], [0.8], np.array([turn]))
    place = GRID if where == "voxels" else BEAMS["cone" if where == "exact rays" else where]
    if where == "exact rays":
        scales = np.minimum(scales, 4.0)  # what reaches the source has no picture
        g = Gaussians.from_physical([centre], [scales], [0.8], np.array([turn]))
    found = compare(g, place, model=RayModel(exact_above=0.0) if where == "exact rays" else None)
    # The weight that errors are relative to is that of the thinnest way through: its picture may be long across.
    assert found.value < bound(FAR, float(scales.min()) / PITCH) + RECURRENCE
