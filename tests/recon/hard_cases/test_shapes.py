"""Gaussians of difficult shape: needles, discs, points, very large ones, singular covariances, zero quaternions.

On the CPU's kernels, and in slow tests on Triton's.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.splatting.gaussians import Gaussians
from tests.recon.hard_cases.measure import RECURRENCE, STEP, bound, compare, gradient_bound
from tests.recon.hard_cases.on import EXACT, PITCH, On, Place, cpu
from tests.recon.helpers import gradients, in_double
from tests.recon.kernels.reference import project


@pytest.mark.parametrize(("beam", "aspect"), [("parallel", 1e2), ("parallel", 1e4), ("leaning", 1e4), ("cone", 50.0)])
def test_a_needle_as_wide_as_a_pixel_keeps_its_digits_at_any_length(on: On, beam: str, aspect: float) -> None:
    thin = 0.5 if beam != "cone" else 0.4
    found = on.compare(on.some((thin, thin, thin * aspect)), on.beams[beam])
    assert found.value < bound(on.far, thin / PITCH)
    assert found.worst < gradient_bound(on.far, thin / PITCH), found.gradients


@pytest.mark.parametrize("aspect", [1e2, 1e4])
def test_a_needle_in_voxels_keeps_its_digits_at_any_length(on: On, aspect: float) -> None:
    found = on.compare(on.some((0.5, 0.5, 0.5 * aspect)), on.grid)
    assert found.value < bound(on.reach, 0.5)
    assert found.worst < gradient_bound(on.reach, 0.5), found.gradients


@pytest.mark.parametrize(("beam", "aspect"), [("parallel", 1e4), ("leaning", 1e2), ("leaning", 1e4), ("cone", 1e4)])
def test_a_needle_thinner_than_a_pixel_is_as_exact_as_its_position(on: On, beam: str, aspect: float) -> None:
    # 8 px long and down to 1e-3 px wide: what is lost is a position's rounding over that width.
    thin = 4 / aspect
    found = on.compare(on.some((thin, thin, 4.0)), on.beams[beam])
    assert found.value < bound(on.far, thin / PITCH)
    assert found.worst < gradient_bound(on.far, thin / PITCH), found.gradients


@pytest.mark.parametrize(
    ("shape", "where"), [((0.04, 0.04, 4.0), "voxels"), ((2.0, 2.0, 2e-2), "voxels"), ((4e-3, 4e-3, 4.0), "cone")]
)
def test_stretches_of_needles_and_discs_are_as_exact_as_positions(on: On, shape: Place, where: str) -> None:
    # Moments along the axes of the image or the grid would lose an aspect squared in them, and in nothing else.
    there = (on.grid, None) if where == "voxels" else (on.beams[where], EXACT)
    found = on.compare(on.some(shape, 8), *there).gradients
    assert found["log_scales"] < 3 * max(found["means"], found["raw_densities"])


@pytest.mark.parametrize(("beam", "thin"), [("parallel", 2e-4), ("leaning", 2e-2), ("cone", 2e-6)])
def test_flat_discs_at_any_angle(on: On, beam: str, thin: float) -> None:
    # No view meets any of these edge-on, so their pictures are wide in both directions.
    found = on.compare(on.some((2.0, 2.0, thin), 10), on.beams[beam])
    narrowest = 0.1
    assert found.value < bound(on.far, narrowest)
    assert found.worst < gradient_bound(on.far, narrowest), found.gradients


@pytest.mark.parametrize("edge_on", [True, False])
def test_a_flat_disc_seen_edge_on_and_face_on(on: On, edge_on: bool) -> None:
    # Thin along x: at 0 degrees a line 0.002 px wide through the middle of a column, at 90 degrees a round spot.
    view = Geometry.parallel([0.0 if edge_on else math.pi / 2], (11, 13), pixel_pitch=PITCH)
    g = Gaussians.from_physical([[0.0, 0.0, 0.0]], [[1e-3, 2.0, 2.0]], [0.8])
    found = on.compare(g, view)
    narrowest = 1e-3 / PITCH if edge_on else 2.0 / PITCH
    assert found.value < bound(on.far, narrowest)
    assert float(found.image.max()) == pytest.approx(
        0.8 * math.sqrt(2 * math.pi) * (2.0 if edge_on else 1e-3), rel=1e-5
    )
    torque = found.gradients.pop("quaternions")
    assert found.worst < gradient_bound(on.far, narrowest), found.gradients
    if edge_on:
        assert torque < gradient_bound(on.far, narrowest)
    else:
        # By symmetry there is none. A rotation's rounding tilts the disc, and a tilt of ε makes it aspect² ε thicker.
        size = float(found.slopes["log_scales"].abs().max())
        assert float(found.slopes["quaternions"].abs().max()) < 2e3**2 * STEP * size


@pytest.mark.parametrize("sigma", [0.2, 0.05, 1e-3])
def test_dots_smaller_than_a_pixel(on: On, sigma: float) -> None:
    # On the lattice of the pixels, and off it by half a standard deviation: else no pixel sees the small ones.
    n, rng = 12, np.random.default_rng(1)
    means = np.round(6 * (rng.random((n, 3)) - 0.5)) + 0.5 * sigma
    dots = Gaussians.from_physical(means, np.full(n, sigma), rng.uniform(0.2, 1, n), density_unit=0.7)
    found = on.compare(dots, Geometry.parallel([0.0], (11, 13), pixel_pitch=1.0))
    assert found.value < bound(20.0, sigma)
    del found.gradients["quaternions"]  # round Gaussians: they are zero, see below
    assert found.worst < gradient_bound(20.0, sigma), found.gradients
    assert on.compare(dots, Grid((9, 9, 9))).value < bound(20.0, sigma)


@pytest.mark.parametrize("sigma", [1e-6, 1e-15])
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


def test_a_turned_ball_feels_no_torque(on: On) -> None:
    # The off-diagonal part of T times (s_k / s_j - s_j / s_k): rounding of the scales' exponentials is all there is.
    for where in (on.beams["parallel"], on.grid):
        found = on.compare(on.some((0.8,) * 3), where)
        size = float(found.slopes["log_scales"].abs().max())
        assert float(found.slopes["quaternions"].abs().max()) < 20 * STEP * size


@pytest.mark.parametrize("sigma", [1e3, 1e7])
def test_gaussians_larger_than_the_field(on: On, sigma: float) -> None:
    g = on.some((sigma, 1.3 * sigma, 0.7 * sigma))
    for where, thin in ((on.beams["leaning"], sigma / PITCH), (on.grid, sigma)):
        found = on.compare(g, where)
        assert found.value < bound(on.far, thin)
        assert found.worst < gradient_bound(on.far, thin), found.gradients


@pytest.mark.parametrize("shape", [(1e-15,) * 3, (1e15,) * 3, (1e-12, 1.0, 1e8)])
def test_a_covariance_that_is_singular_to_rounding_is_finite(on: On, shape: Place) -> None:
    # Σ₂ in float32 has no inverse here: its determinant is a difference of equal numbers, zero or negative.
    places: list[Geometry | Grid] = [*on.beams.values(), on.grid]
    for where in places:
        g = on.leaves(on.some(shape, 6))
        image = on.shown(g, where)
        assert torch.isfinite(image).all() and float(image.detach().min()) >= 0
        assert float(image.detach().max()) <= 6 * math.sqrt(2 * math.pi) * max(shape)
        image.sum().backward()
        assert all(torch.isfinite(slope).all() for slope in gradients(g).values())


@pytest.mark.parametrize("length", [1e-11, 1e30, 1e38])
def test_quaternions_of_any_length_give_the_same_picture(on: On, length: float) -> None:
    g = on.some((0.4, 0.9, 1.7))
    unit = g.quaternions / g.quaternions.norm(dim=1, keepdim=True)
    found = on.compare(replace(g, quaternions=unit * length), on.beams["leaning"])
    expected = project(in_double(g), on.beams["leaning"]).detach()
    np.testing.assert_allclose(found.image, expected, atol=1e-5 * float(expected.max()))
    if length == 1e38:  # 1 / 2e38 is a denormal number
        del found.gradients["quaternions"]
    assert found.worst < gradient_bound(on.far, 0.8), found.gradients


@pytest.mark.parametrize("length", [0.0, 1e-30])
def test_a_quaternion_of_no_length_is_no_rotation_and_feels_nothing(on: On, length: float) -> None:
    assert np.float32(length) * np.float32(length) == 0  # naive: the rotation is 0 / 0
    g = on.some((0.4, 0.9, 1.7))
    still, identity = torch.zeros_like(g.quaternions), torch.zeros_like(g.quaternions)
    still[:, 2], identity[:, 0] = length, 1.0
    leaves, plain = (on.leaves(replace(g, quaternions=q)) for q in (still, identity))
    image, expected = (on.shown(each, on.beams["parallel"]) for each in (leaves, plain))
    np.testing.assert_array_equal(image.detach().cpu(), expected.detach().cpu())
    image.sum().backward()
    slopes = gradients(leaves)
    assert not slopes["quaternions"].any() and all(torch.isfinite(slope).all() for slope in slopes.values())


_ON = cpu()
exponents = st.floats(-4, 4)


@pytest.mark.slow
@given(
    shape=st.tuples(exponents, exponents, exponents),
    turn=st.tuples(*(st.floats(-1, 1),) * 4).filter(lambda q: sum(x * x for x in q) > 1e-6),
    centre=st.tuples(*(st.floats(-8, 8),) * 3),
    where=st.sampled_from([*_ON.beams, "exact rays", "voxels"]),
)
def test_any_shape_is_within_its_bound(
    shape: Place, turn: tuple[float, ...], centre: tuple[float, ...], where: str
) -> None:
    scales = 10 ** np.array(shape)
    g = Gaussians.from_physical([centre], [scales], [0.8], np.array([turn]))
    place = _ON.grid if where == "voxels" else _ON.beams["cone" if where == "exact rays" else where]
    if where == "exact rays":
        scales = np.minimum(scales, 4.0)  # what reaches the source has no picture
        g = Gaussians.from_physical([centre], [scales], [0.8], np.array([turn]))
    found = compare(g, place, model=EXACT if where == "exact rays" else None)
    # The weight that errors are relative to is that of the thinnest way through: its picture may be long across.
    assert found.value < bound(_ON.far, float(scales.min()) / PITCH) + RECURRENCE
