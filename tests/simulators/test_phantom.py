"""Phantom against independent closed forms: indicators along rays, masses, moments, line sums of the voxel truth."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from recon.geometry import Geometry
from recon.volume import Grid
from simulators.battery import ELECTROLYTE, PARTICLE, battery
from simulators.detector import Detector
from simulators.phantom import Phantom
from simulators.solids import Box, Cylinder, Ellipsoid, Octahedron, Solid, Tube

ANGLES = st.floats(-7.0, 7.0)

CENTRE, QUATERNION = (0.11, -0.07, 0.05), (0.8, -0.3, 0.5, 0.4)
SOLIDS: dict[str, Solid] = {
    "cylinder": Cylinder(0.3, 0.5, 2.0, CENTRE),
    "tube": Tube(0.3, 0.22, 0.5, 2.0, CENTRE),
    "sphere": Ellipsoid((0.25, 0.25, 0.25), 1.5, CENTRE),
    "ellipsoid": Ellipsoid((0.35, 0.2, 0.1), 1.5, CENTRE, QUATERNION),
    "upright box": Box((0.5, 0.3, 0.4), 1.2, CENTRE),
    "box": Box((0.5, 0.3, 0.4), 1.2, CENTRE, QUATERNION),
    "octahedron": Octahedron((0.3, 0.25, 0.35), 1.2, CENTRE, QUATERNION),
}


def _inside(solid: Solid, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Indicator of a solid at points [..., 3], written apart from the package's own."""
    q = points - np.array(solid.centre)
    if isinstance(solid, Cylinder | Tube):
        r, tall = np.hypot(q[..., 0], q[..., 1]), np.abs(q[..., 2]) <= solid.height / 2
        if isinstance(solid, Cylinder):
            return (r <= solid.radius) & tall
        return (r <= solid.outer_radius) & (r > solid.inner_radius) & tall
    w, x, y, z = solid.quaternion
    q = Rotation.from_quat([x, y, z, w]).inv().apply(q.reshape(-1, 3)).reshape(q.shape)
    if isinstance(solid, Ellipsoid):
        return ((q / np.array(solid.semi_axes)) ** 2).sum(-1) <= 1
    if isinstance(solid, Box):
        return (np.abs(q) <= np.array(solid.edges) / 2).all(-1)
    return (np.abs(q) / np.array(solid.half_diagonals)).sum(-1) <= 1


def _numeric(f: Callable[[NDArray[np.float64]], NDArray[np.float64]], angle: float, detector: Detector, n: int = 4001):
    """Line integrals of f over rays built from the definition u = x cos θ + y sin θ, by the midpoint rule."""
    t = (np.arange(n) + 0.5) / n * 2 - 1
    c, s = math.cos(angle), math.sin(angle)
    u, v = detector.u()[None, :, None], detector.v()[:, None, None]
    shape = np.broadcast_shapes(u.shape, v.shape, t.shape)
    points = np.stack([np.broadcast_to(a, shape) for a in (u * c - t * s, u * s + t * c, v)], axis=-1)
    return f(points).sum(-1) * 2 / n


@pytest.mark.parametrize("name", SOLIDS)
@pytest.mark.parametrize("angle", [0.0, 0.7, math.pi / 2, -2.5])
def test_chords_are_the_integrals_of_the_indicator(name: str, angle: float) -> None:
    solid = SOLIDS[name]
    detector = Detector((9, 12), 0.083, axis_col=5.2, axis_row=4.3)
    expected = solid.attenuation * _numeric(lambda p: _inside(solid, p).astype(float), angle, detector)
    got = Phantom.of([solid]).line_integrals(angle, detector)
    assert (expected > 0).sum() > 10
    # An indicator counted at 2/4001 mm is out by at most one step at each of the (up to four) crossings.
    np.testing.assert_allclose(got, expected, atol=solid.attenuation * 4 * 2 / 4001)


@pytest.mark.parametrize("name", SOLIDS)
@settings(max_examples=15, deadline=None)
@given(angle=ANGLES)
def test_mass_is_volume_times_density_at_every_angle(name: str, angle: float) -> None:
    solid = SOLIDS[name]
    detector = Detector.centred((240, 260), 0.005)
    mass = Phantom.of([solid]).line_integrals(angle, detector).sum() * detector.pitch**2
    assert mass == pytest.approx(solid.attenuation * solid.volume, rel=0.01)


def _moments(phantom: Phantom, angle: float, detector: Detector) -> list[float]:
    profile = phantom.line_integrals(angle, detector).sum(axis=0) * detector.pitch**2
    return [float((profile * detector.u() ** n).sum()) for n in range(3)]


@settings(max_examples=25, deadline=None)
@given(angle=ANGLES)
def test_moments_obey_helgason_and_ludwig(angle: float) -> None:
    """The n-th moment in u is a homogeneous polynomial of degree n in cos θ and sin θ (Helgason 1965, Ludwig 1966)."""
    solids = battery(np.random.default_rng(3), (0.9, 0.9), n_particles=40)
    phantom, detector = Phantom.of(solids), Detector((300, 307), 0.003, axis_col=151.3, axis_row=149.7)
    c, s = math.cos(angle), math.sin(angle)
    zeroth, first, second = _moments(phantom, angle, detector)
    masses = np.array([solid.attenuation * solid.volume for solid in solids])
    centre = masses @ np.array([solid.centre for solid in solids])
    assert zeroth == pytest.approx(masses.sum(), rel=2e-3)
    assert first == pytest.approx(centre[0] * c + centre[1] * s, abs=2e-4 * masses.sum())
    at_0, at_45, at_90 = (_moments(phantom, a, detector)[2] for a in (0.0, math.pi / 4, math.pi / 2))
    cross = 2 * at_45 - at_0 - at_90
    assert second == pytest.approx(at_0 * c * c + cross * c * s + at_90 * s * s, rel=2e-3)


def test_convention_is_the_geometry_s() -> None:
    """Columns grow with u = x cos θ + y sin θ, rows with z; pixel centres as recon.geometry counts them."""
    geometry = Geometry.parallel([0.0], (40, 50), pixel_pitch=0.02, axis_col=21.5)
    detector = Detector(geometry.detector_shape, geometry.pixel_pitch, geometry.axis_col, axis_row=19.5)
    ball = Phantom.of([Ellipsoid((0.1, 0.1, 0.1), 1.0, (0.2, 0.1, 0.16))])
    rows, cols = np.mgrid[:40, :50]
    for angle in (0.0, 0.5, math.pi / 2, math.pi, 4.0):
        view = ball.line_integrals(angle, detector)
        u = 0.2 * math.cos(angle) + 0.1 * math.sin(angle)
        assert (view * cols).sum() / view.sum() == pytest.approx(21.5 + u / 0.02, abs=0.05)
        assert (view * rows).sum() / view.sum() == pytest.approx(19.5 + 0.16 / 0.02, abs=0.05)


def test_each_row_may_have_its_own_angle() -> None:
    phantom = Phantom.of(list(SOLIDS.values()))
    detector = Detector.centred((24, 30), 0.04)
    angles = np.linspace(0.2, 0.9, 24)
    rows = [phantom.line_integrals(angle, detector)[j] for j, angle in enumerate(angles)]
    np.testing.assert_array_equal(phantom.line_integrals(angles, detector), rows)


def test_attenuations_add_up_and_may_be_negative() -> None:
    outer, hole = Cylinder(0.3, 0.4, 2.0), Cylinder(0.2, 0.4, -2.0)
    detector = Detector.centred((20, 40), 0.02)
    both = Phantom.of([outer, hole]).line_integrals(0.3, detector)
    np.testing.assert_allclose(both, Phantom.of([Tube(0.3, 0.2, 0.4, 2.0)]).line_integrals(0.3, detector), atol=1e-15)


def test_solids_partly_or_wholly_outside_the_frame() -> None:
    far = [Ellipsoid((0.1, 0.1, 0.1), 1.0, (5.0, 0.0, 0.0)), Box((0.1, 0.1, 0.1), 1.0, (0.0, 0.0, -5.0))]
    assert not Phantom.of(far).line_integrals(0.0, Detector.centred((8, 8), 0.02)).any()
    assert not Phantom.of(far).attenuation(Grid((8, 8, 8), 0.02)).any()
    wide = Phantom.of([Cylinder(3.0, 9.0, 1.0)])
    assert wide.line_integrals(1.0, Detector.centred((2, 3), 0.02))[0, 1] == pytest.approx(6.0)
    assert wide.attenuation(Grid((2, 2, 2), 0.02)).min() == 1.0
    assert not Phantom.of([]).line_integrals(0.0, Detector.centred((2, 3), 0.02)).any()


@pytest.mark.parametrize("name", SOLIDS)
def test_truth_has_the_solid_s_mass(name: str) -> None:
    solid = SOLIDS[name]
    grid = Grid((50, 56, 60), 0.018, centre=(0.02, -0.03, 0.04))
    truth = Phantom.of([solid]).attenuation(grid, supersample=4)
    assert truth.dtype == np.float32
    mass = truth.sum(dtype=np.float64) * grid.voxel_size**3
    # Faces along the voxels all fall between the same two sub-points: each edge is out by up to one sub-step.
    tolerance = sum(0.018 / 4 / edge for edge in solid.edges) if name == "upright box" else 3e-3
    assert mass == pytest.approx(solid.attenuation * solid.volume, rel=tolerance)
    z, y, x = grid.coordinates()
    points = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1)
    sure = (truth == 0) | (truth == np.float32(solid.attenuation))
    np.testing.assert_array_equal(truth[sure] > 0, _inside(solid, points)[sure])


def test_truth_on_a_face_is_the_filled_share() -> None:
    grid = Grid((1, 1, 8), 1.0)  # x at -3.5 ... 3.5
    truth = Phantom.of([Box((5.0, 9.0, 9.0), 4.0)]).attenuation(grid, supersample=2)
    np.testing.assert_allclose(truth[0, 0], [0, 2, 4, 4, 4, 4, 2, 0])


def test_line_sums_of_the_truth_are_the_projection() -> None:
    """The voxel truth and the analytic projection meet in a third thing: plain sums over an axis of the truth."""
    phantom = Phantom.of(battery(np.random.default_rng(1), (0.9, 0.9), n_particles=30))
    n, fine = 48, 4
    grid = Grid((n, n, n), 0.9 / n)
    truth = phantom.attenuation(grid, supersample=4).astype(np.float64)
    detector = Detector.centred((n * fine, n * fine), grid.voxel_size / fine)
    sums = {
        0.0: truth.sum(axis=1),
        math.pi / 2: truth.sum(axis=2),
        math.pi: truth.sum(axis=1)[:, ::-1],
        -math.pi / 2: truth.sum(axis=2)[:, ::-1],
    }
    for angle, expected in sums.items():
        view = phantom.line_integrals(angle, detector).reshape(n, fine, n, fine).mean(axis=(1, 3))
        error = view - expected * grid.voxel_size
        assert np.abs(error).max() < 0.05 * view.max(), angle
        assert np.sqrt(np.mean(error**2)) < 0.004 * view.max(), angle


def test_interpolated_truth_along_oblique_rays() -> None:
    phantom = Phantom.of([SOLIDS["ellipsoid"], SOLIDS["box"]])
    grid = Grid((64, 64, 64), 0.9 / 64)
    truth = phantom.attenuation(grid)

    def sample(points: NDArray[np.float64]) -> NDArray[np.float64]:
        index = points[..., ::-1] / grid.voxel_size + (np.array(grid.shape) - 1) / 2
        return map_coordinates(truth, np.moveaxis(index, -1, 0), order=1)

    detector = Detector.centred((20, 24), 0.03)
    for angle in (0.6, 2.2):
        view = phantom.line_integrals(angle, detector)
        error = view - _numeric(sample, angle, detector, n=400)
        assert np.sqrt(np.mean(error**2)) < 0.015 * view.max(), angle


@pytest.mark.parametrize("field", [(0.9, 0.9), (0.72, 0.3), (2.0, 5.0)])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_battery_is_dense_inside_the_field_and_lets_light_through(field: tuple[float, float], seed: int) -> None:
    solids = battery(np.random.default_rng(seed), field)
    assert len(solids) == 152
    phantom = Phantom.of(solids)
    detector = Detector.centred((120, 120), max(field) / 120)
    views = np.stack([phantom.line_integrals(a, detector) for a in np.linspace(0, np.pi, 20, endpoint=False)])
    assert 1.5 < views.max() < 3.0  # at least 5 % of the beam comes through
    outside = (np.abs(detector.u()) > field[0] * 0.45)[None, :] | (np.abs(detector.v()) > field[1] * 0.455)[:, None]
    assert outside[60, 0] or outside[0, 60]
    assert not views[:, outside].any()
    particles = solids[2:]
    share = sum(p.volume for p in particles) / solids[1].volume
    assert 0.08 < share < 0.16
    assert {type(p) for p in particles} == {Ellipsoid, Octahedron, Box}
    sizes = np.cbrt([p.volume for p in particles])
    assert sizes.max() > 1.8 * sizes.min()


def test_battery_s_particles_do_not_overlap() -> None:
    solids = battery(np.random.default_rng(5), (1.0, 1.0))
    truth = Phantom.of(solids[1:]).attenuation(Grid((110, 110, 110), 1 / 110))
    one = (ELECTROLYTE + PARTICLE) / 0.44
    assert truth.max() == pytest.approx(one)  # two particles in a voxel would make nearly twice that
    alone = Phantom.of(solids[2:]).attenuation(Grid((110, 110, 110), 1 / 110)).sum(dtype=np.float64) / 110**3
    assert alone == pytest.approx(sum(p.attenuation * p.volume for p in solids[2:]), rel=2e-3)


def test_battery_repeats_with_its_seed_and_refuses_what_does_not_fit() -> None:
    assert battery(np.random.default_rng(4)) == battery(np.random.default_rng(4))
    assert battery(np.random.default_rng(4)) != battery(np.random.default_rng(5))
    assert len(battery(np.random.default_rng(4), n_particles=0)) == 2
    with pytest.raises(ValueError, match=r"only \d+ of 50 particles find room .* lower fill"):
        battery(np.random.default_rng(4), n_particles=50, fill=0.9)
    with pytest.raises(ValueError, match="field_of_view must be"):
        battery(np.random.default_rng(4), (0.0, 1.0))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Cylinder(0.0, 1.0, 1.0), "cylinder: radius must be positive in mm, got 0.0"),
        (lambda: Tube(0.2, 0.3, 1.0, 1.0), "outer_radius must exceed the inner 0.3"),
        (lambda: Ellipsoid((0.1, -0.1, 0.1), 1.0), "ellipsoid: semi_axes must be"),
        (lambda: Box((0.1, 0.1, math.nan), 1.0), "box: edges must be"),
        (lambda: Box((0.1, 0.1, 0.1), 1.0, quaternion=(0, 0, 0, 0)), "not all zero"),
        (lambda: Octahedron((0.1, 0.1, 0.1), math.inf), "must be finite"),
    ],
)
def test_impossible_solids_are_refused(make: Callable[[], Solid], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()
