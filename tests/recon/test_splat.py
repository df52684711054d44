"""The CPU kernels against the float64 twin, the twin against closed forms and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.gaussians import Gaussians
from recon.geometry import Geometry
from recon.splat import Truncation, project, voxelize
from recon.volume import Grid
from tests.recon.conftest import Make
from tests.recon.helpers import as_leaves, gradients, in_double

# No cut-off worth the name, so that kernel and twin sum the same terms.
WHOLE = Truncation(sigmas=9.0, faint=1e-12)
SHAPE = (24, 30)


def geometry(angles: tuple[float, ...] = (0.0, 0.7, 2.5, -4.0)) -> Geometry:
    return Geometry.parallel(angles, SHAPE, pixel_pitch=0.5, axis_col=13.3)


def test_one_isotropic_gaussian_projects_to_the_closed_form() -> None:
    # ∫ ρ exp(-r²/2σ²) dt = ρ σ √(2π) exp(-(u² + v²)/2σ²), the same from every side.
    sigma, density, centre = 1.3, 0.8, np.array([1.2, -0.7, 0.9])
    g = Gaussians.from_physical(centre[None], [sigma], [density])
    views = geometry()
    images = project(g, views, truncation=WHOLE).numpy()
    u = (np.arange(SHAPE[1]) - views.axis_col) * views.pixel_pitch
    v = (np.arange(SHAPE[0]) - (SHAPE[0] - 1) / 2) * views.pixel_pitch
    for image, angle in zip(images, views.angles, strict=True):
        du = u - (centre[0] * math.cos(angle) + centre[1] * math.sin(angle))
        r2 = du[None, :] ** 2 + (v[:, None] - centre[2]) ** 2
        expected = density * sigma * math.sqrt(2 * math.pi) * np.exp(-r2 / (2 * sigma**2))
        np.testing.assert_allclose(image, expected, atol=2e-6 * expected.max() + 1e-6)


def test_projection_is_the_integral_along_the_ray(random_gaussians: Make) -> None:
    # Independent of every formula for the projected footprint: sum the density along rays, numerically.
    g = in_double(random_gaussians(12, extent=6.0))
    angle = 0.9
    views = Geometry.parallel([angle], (5, 7), pixel_pitch=1.1, axis_col=2.4)
    image = project(g, views)[0].detach().numpy()
    t = np.linspace(-14, 14, 2801)
    inverse = np.linalg.inv(_covariances(g))
    for row in range(5):
        for col in range(7):
            u, v = (col - 2.4) * 1.1, (row - 2) * 1.1
            points = np.stack(
                (
                    u * math.cos(angle) - t * math.sin(angle),
                    u * math.sin(angle) + t * math.cos(angle),
                    np.full_like(t, v),
                ),
                1,
            )
            offset = points[None] - g.means.detach().numpy()[:, None]
            exponent = np.einsum("nti,nij,ntj->nt", offset, inverse, offset)
            density = (g.densities.detach().numpy()[:, None] * np.exp(-0.5 * exponent)).sum(0)
            assert image[row, col] == pytest.approx(np.trapezoid(density, t), rel=1e-6, abs=1e-9)


@settings(deadline=None, max_examples=25)
@given(angle=st.floats(-10, 10), seed=st.integers(0, 10_000))
def test_mass_is_the_same_from_every_side(angle: float, seed: int) -> None:
    # Σ pixels * pitch² = Σ ρ (2π)^(3/2) |S|: the zeroth Helgason-Ludwig moment.
    rng = np.random.default_rng(seed)
    scales = rng.uniform(0.8, 1.6, (6, 3))
    g = Gaussians.from_physical(rng.uniform(-3, 3, (6, 3)), scales, rng.uniform(0.1, 1, 6), rng.normal(size=(6, 4)))
    views = Geometry.parallel([angle], (64, 64), pixel_pitch=0.5)
    mass = float(project(g, views, truncation=WHOLE).sum()) * 0.25
    expected = float((g.densities.double() * g.scales.double().prod(1)).sum()) * (2 * math.pi) ** 1.5
    assert mass == pytest.approx(expected, rel=1e-4)


def test_cpu_projection_equals_the_twin(random_gaussians: Make) -> None:
    g = random_gaussians()
    fast = project(g, geometry(), truncation=WHOLE)
    twin = project(in_double(g), geometry()).detach()
    assert float((fast - twin).abs().max()) < 3e-6 * float(twin.max())


def test_cpu_projection_gradients_equal_the_twins(random_gaussians: Make, rng: np.random.Generator) -> None:
    g = random_gaussians()
    weights = torch.from_numpy(rng.normal(size=(4, *SHAPE)))
    fast, twin = as_leaves(g), in_double(g)
    (project(fast, geometry(), truncation=WHOLE) * weights.float()).sum().backward()
    (project(twin, geometry()) * weights).sum().backward()
    for name, expected in gradients(twin).items():
        found = gradients(fast)[name]
        assert float((found - expected).abs().max()) < 2e-5 * float(expected.abs().max()), name


def test_the_twins_gradients_equal_finite_differences(random_gaussians: Make) -> None:
    g = in_double(random_gaussians(3, extent=4.0))
    views = Geometry.parallel([0.4, 1.9], (6, 7))
    tensors = (g.means, g.log_scales, g.quaternions, g.raw_densities)
    assert torch.autograd.gradcheck(lambda *t: project(Gaussians(*t, 0.7), views), tensors)
    grid = Grid((3, 4, 3), 1.3)
    assert torch.autograd.gradcheck(lambda *t: voxelize(Gaussians(*t, 0.7), grid), tensors)


def test_cpu_voxels_and_gradients_equal_the_twins(random_gaussians: Make, rng: np.random.Generator) -> None:
    g = random_gaussians()
    grid = Grid((9, 12, 20), 0.6, centre=(0.4, -0.8, 1.1))
    weights = torch.from_numpy(rng.normal(size=grid.shape))
    fast, twin = as_leaves(g), in_double(g)
    a, b = voxelize(fast, grid, truncation=WHOLE), voxelize(twin, grid)
    assert float((a - b).detach().abs().max()) < 3e-6 * float(b.detach().max())
    (a * weights.float()).sum().backward()
    (b * weights).sum().backward()
    for name, expected in gradients(twin).items():
        found = gradients(fast)[name]
        assert float((found - expected).abs().max()) < 2e-5 * float(expected.abs().max()), name


def test_projection_is_linear_in_density_and_its_adjoint_is_the_density_gradient(
    random_gaussians: Make, rng: np.random.Generator
) -> None:
    # <A ρ, y> = <ρ, Aᵀ y> with A the footprints and Aᵀ the first moment of the backward pass.
    g = as_leaves(random_gaussians())
    y = torch.from_numpy(rng.normal(size=(4, *SHAPE)).astype(np.float32))
    image = project(g, geometry(), truncation=WHOLE)
    (image * y).sum().backward()
    slope = g.density_unit * torch.sigmoid(g.raw_densities.detach())
    back = gradients(g)["raw_densities"] / slope
    left = float((image.detach().double() * y).sum())
    right = float((g.densities.detach().double() * back).sum())
    assert left == pytest.approx(right, rel=1e-5)


def test_a_sub_volume_is_the_cut_out_of_the_volume(random_gaussians: Make) -> None:
    g = random_gaussians(80)
    whole = Grid((16, 18, 20), 0.7)
    z, y, x = whole.coordinates()
    part = Grid((5, 6, 7), 0.7, centre=(float(z[3:8].mean()), float(y[4:10].mean()), float(x[9:16].mean())))
    cut = voxelize(g, whole, truncation=WHOLE).numpy()[3:8, 4:10, 9:16]
    np.testing.assert_allclose(voxelize(g, part, truncation=WHOLE).numpy(), cut, atol=1e-5 * float(cut.max()))


def test_default_truncation_loses_little(random_gaussians: Make) -> None:
    g = random_gaussians()
    whole = project(g, geometry(), truncation=WHOLE)
    cut = project(g, geometry())
    # 3.5 σ leave exp(-6.1) = 0.2 % of a footprint's mass outside.
    assert float(cut.sum() / whole.sum()) == pytest.approx(1, abs=0.004)
    assert float((whole - cut).abs().max()) < 0.01 * float(whole.max())


@pytest.mark.parametrize(("above", "seen"), [(1.5, True), (0.7, False)])
def test_what_is_faint_is_left_out(above: float, seen: bool) -> None:
    # A projection's limit is the fraction times the field times the density unit, a volume's times the unit alone.
    cut, unit, sigma = Truncation(3.5, 1e-3), 0.7, 0.8
    views = geometry()
    peak = above * cut.faint * unit * SHAPE[1] * views.pixel_pitch
    one = Gaussians.from_physical([[0.0, 0, 0]], [sigma], [peak / (sigma * math.sqrt(2 * math.pi))], density_unit=unit)
    assert bool(project(one, views, truncation=cut).any()) == seen
    one = Gaussians.from_physical([[0.0, 0, 0]], [sigma], [above * cut.faint * unit], density_unit=unit)
    assert bool(voxelize(one, Grid((5, 5, 5), 0.5), truncation=cut).any()) == seen


@settings(deadline=None, max_examples=40)
@given(
    exponent=st.floats(-3, 3),
    aspect=st.floats(0, 3),
    far=st.sampled_from([0.0, 1.0, 30.0, 1e4]),
    length=st.sampled_from([0.0, 1e-30, 1e-6, 1.0, 1e6]),
)
def test_extreme_gaussians_stay_finite(exponent: float, aspect: float, far: float, length: float) -> None:
    base = 10.0**exponent
    g = Gaussians(
        torch.tensor([[far, -far, far / 2], [0.1, 0.2, 0.3]]),
        torch.log(torch.tensor([[base, base * 10**aspect, base], [0.5, 0.5, 0.5]])),
        torch.tensor([[length, 0.0, length, 0.0], [1.0, 0.2, 0.0, 0.0]]),
        torch.tensor([-80.0, 0.5]),
    )
    leaves = as_leaves(g)
    image = project(leaves, geometry())
    assert torch.isfinite(image).all() and float(image.detach().min()) >= 0
    image.sum().backward()
    assert all(torch.isfinite(value).all() for value in gradients(leaves).values())
    volume = voxelize(g, Grid((6, 7, 8)))
    assert torch.isfinite(volume).all() and float(volume.min()) >= 0


def test_the_cpu_kernel_refuses_doubles(random_gaussians: Make) -> None:
    with pytest.raises(ValueError, match="float32"):
        project(in_double(random_gaussians(2)), geometry(), kernel="cpu")


def _covariances(g: Gaussians) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(g.quaternions.detach().numpy(), scalar_first=True).as_matrix()
    shaped = turn * g.scales.detach().numpy()[:, None, :]
    return shaped @ shaped.transpose(0, 2, 1)
