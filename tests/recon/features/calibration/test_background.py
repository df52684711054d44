"""Background learnt with the volume: taken off where no ray misses the sample, and nothing of the sample with it."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.features.calibration.background import LearntBackground, learn_background
from recon.voxels.iterative import solve
from recon.voxels.methods import FistaTv
from recon.voxels.projector import Projector
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid

pytestmark = pytest.mark.usefixtures("one_thread")
F32 = NDArray[np.float32]
SHAPE, VIEWS = (24, 48), 60
GEOMETRY = Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), SHAPE, pixel_pitch=1.0, axis_col=24.3)
TIMES = np.linspace(0, 1, VIEWS)
SOFT, NOISE = 0.01, 0.003  # 1/px; line integrals
INSIDE, ROWS = 22.0, slice(2, 22)  # px about the axis, and slices, in which volumes are compared


def _thorax(scale: float) -> tuple[Ellipsoid, ...]:
    """Soft tissue with two lungs, spine and ribs; weak and dense bodies of soft tissue beside them."""

    def body(a: float, b: float, density: float, x: float, y: float, z: float = 0.0, c: float = 1e4) -> Ellipsoid:
        return Ellipsoid((a * scale, b * scale, c), density * SOFT, centre=(x * scale, y * scale, z))

    return (
        body(20, 14, 1.0, 0, 0), body(7, 9, -0.7, -9, 1), body(7, 9, -0.7, 9, 1), body(3, 3, 2.0, 0, 10),
        body(1.2, 2.2, 2.0, -17, 0), body(1.2, 2.2, 2.0, 17, 0),
        body(3, 4, 0.1, 0, -4.5, -3, 4), body(2, 2, 0.5, 9, 2, 4, 3),
    )  # fmt: skip


def _can(radius: float, *bodies: Ellipsoid) -> tuple[Cylinder | Ellipsoid, ...]:
    return Cylinder(radius + 4, 300, SOFT), Cylinder(radius, 300, -SOFT), *bodies


THORAX, CAN = _thorax(1.1), _can(22.0, *_thorax(0.75))  # no ray misses the can, whose wall ends beyond the field
DOME = Ellipsoid((11, 11, 9), 0.0015, centre=(1, 0, -1)), Cylinder(9, 10, 0.05, centre=(0, 0, 8))
HARD = Cylinder(12, 20, 0.2), Cylinder(10, 20, -0.1), Cylinder(3, 20, 0.4, centre=(5, 0, 0))  # as a small battery


def _views(bodies: tuple[Cylinder | Ellipsoid, ...]) -> F32:
    sample, detector = Phantom.of(bodies), Detector(SHAPE, 1.0, GEOMETRY.axis_col, GEOMETRY.axis_row)
    clean = np.stack([sample.line_integrals(angle, detector) for angle in GEOMETRY.angles])
    return (clean + np.random.default_rng(0).normal(0, NOISE, clean.shape)).astype(np.float32)


def _bent(level: float = -0.06, across: float = 0.06, down: float = 0.03, drift: float = 0.01) -> F32:
    """As the effect beam_bend: level + drift t + curvature x² of line integral."""
    v, u = ((2 * (np.arange(n) + 0.5) / n - 1) ** 2 for n in SHAPE)
    mean = level + across * u + down * v[:, None]
    return (mean + drift * (2 * TIMES - 1)[:, None, None]).astype(np.float32)


class Judged(NamedTuple):
    psnr: float
    mass: float


def _judged(views: F32, bodies: tuple[Cylinder | Ellipsoid, ...], soft: float = SOFT) -> Judged:
    """PSNR of FISTA-TV, and the mass of soft tissue, over their truth."""
    grid = Grid.matching(GEOMETRY)
    z, y, x = grid.coordinates()
    truth = np.zeros(grid.shape)
    for body, dz, dy, dx in itertools.product(bodies, (-0.25, 0.25), (-0.25, 0.25), (-0.25, 0.25)):
        at = x + dx - body.centre[0], y[:, None] + dy - body.centre[1], z[:, None, None] + dz - body.centre[2]
        if isinstance(body, Cylinder):
            within = (np.hypot(at[0], at[1]) <= body.radius) & (np.abs(at[2]) <= body.height / 2)
        else:
            within = sum((o / a) ** 2 for o, a in zip(at, body.semi_axes, strict=True)) <= 1
        truth += body.attenuation / 8 * within
    found = solve(FistaTv(10, 3e-3), Projector(GEOMETRY, grid), views).data
    seen = np.hypot(y[:, None], x) < INSIDE
    error, true = (found - truth)[ROWS][:, seen], truth[ROWS][:, seen]
    of_soft = np.abs(true / soft - 1) < 0.2
    found_mass = (error + true)[of_soft].sum() / true[of_soft].sum()
    return Judged(float(10 * np.log10(true.max() ** 2 / np.mean(error**2))), float(found_mass))


def _learnt(views: F32) -> tuple[LearntBackground, F32]:
    found, levelled = learn_background(views, GEOMETRY, TIMES), views.copy()
    found.remove(levelled, TIMES)
    return found, levelled


@pytest.mark.parametrize(
    ("bodies", "least"), [pytest.param(THORAX, 5.0, id="thorax"), pytest.param(CAN, 2.5, id="can, no air beside it")]
)
def test_a_bent_beam_is_learnt_where_no_ray_or_few_miss_the_sample(
    bodies: tuple[Cylinder | Ellipsoid, ...], least: float
) -> None:
    """Soft tissue beside bone gets its mass back; PSNR rises by `least` dB."""
    views = _views(bodies) + _bent()
    found, levelled = _learnt(views)
    before, after = _judged(views, bodies), _judged(levelled, bodies)
    print(f"\n{before.psnr:.2f} dB, mass {before.mass:.3f}; learnt: {after.psnr:.2f} dB, mass {after.mass:.3f}")
    assert found.mean and found.left < 0.75 * found.without
    assert after.psnr > before.psnr + least
    assert before.mass < 0.9 and abs(after.mass - 1) < 0.06


def test_weak_matter_comes_back_on_a_dense_post() -> None:
    views = _views(DOME) + _bent()
    before, after = (_judged(each, DOME, 0.0015).mass for each in (views, _learnt(views)[1]))
    assert before < 0.1 and after > 0.65


def test_a_drift_is_what_no_volume_holds() -> None:
    drift = _bent(0, 0, 0, 0.03) + (0.03 * (2 * TIMES - 1)[:, None, None] * _bent(0, 1, 0, 0)).astype(np.float32)
    clean = _views(THORAX)
    found, levelled = _learnt(clean + drift)
    assert found.drift and not found.mean
    assert np.sqrt(np.mean((levelled - clean) ** 2)) < 0.1 * np.sqrt(np.mean(drift**2))


@pytest.mark.parametrize(
    "bodies",
    [
        pytest.param(THORAX, id="thorax"),
        pytest.param(CAN, id="no air"),
        pytest.param(DOME, id="dome"),
        pytest.param((*DOME, Cylinder(22, 60, 0.0008)), id="weak matter all around"),
        pytest.param(_thorax(1.7), id="wider than the field"),
        pytest.param(HARD, id="battery"),
        pytest.param((Cylinder(10, 60, 0.02),), id="round"),
    ],
)
@pytest.mark.parametrize("haze", [0.0, 0.03])
def test_nothing_is_taken_off_beams_as_their_flats_or_a_haze(
    bodies: tuple[Cylinder | Ellipsoid, ...], haze: float
) -> None:
    """A positive constant of all views looks like weak matter all around."""
    views = _views(bodies) + np.float32(haze)
    found, levelled = _learnt(views)
    assert not (found.drift or found.mean)
    np.testing.assert_array_equal(levelled, views)


def test_few_views_are_refused() -> None:
    with pytest.raises(ValueError, match="23 views are too few"):
        learn_background(np.ones((23, *SHAPE), np.float32), GEOMETRY.select(np.arange(23)), TIMES[:23])


@pytest.mark.parametrize("rows", [1, 2])
def test_few_rows_have_no_slope_of_their_own(rows: int) -> None:
    views, low = _views(THORAX)[:, :rows] + _bent(down=0)[:, :rows], GEOMETRY.rows(0, rows)
    found = learn_background(np.ascontiguousarray(views), low, TIMES)
    assert np.isfinite(found.coefficients).all() and found.lowest > -0.1


def test_pixels_that_were_not_measured_do_not_count() -> None:
    views, measured = _views(THORAX) + _bent(), np.ones(SHAPE, bool)
    measured[4:10, 6:14] = False
    views[:, ~measured] = 3.0
    found = learn_background(views, GEOMETRY, TIMES, measured)
    assert found.mean and found.lowest == pytest.approx(-0.06, abs=0.025)
