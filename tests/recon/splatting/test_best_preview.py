"""The volume that is shown during a scan: the one that predicts held-out projections better."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from recon import Geometry, Grid
from recon.assess.metrics import psnr
from recon.base.method import ReconProblem, RunControl
from recon.base.view_data import Views
from recon.splatting.anytime import PredictionErrors, direct_volume, volume_error
from recon.splatting.r2 import R2
from recon.splatting.stream import StreamingFit
from recon.splatting.time_limit import FinalFit
from recon.voxels.projector import Projector
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid
from tests.clock import SteppedClock
from tests.slow_cases import others_slow

pytestmark = pytest.mark.usefixtures("one_thread")

SHAPE, PITCH = (12, 36), 0.1
ANGLES = np.linspace(0, np.pi, 48, endpoint=False)
VIEWS = Geometry.parallel(ANGLES, SHAPE, pixel_pitch=PITCH)
GRID = Grid.matching(VIEWS)
PHANTOM = Phantom.of(
    (
        Cylinder(1.4, 0.9, 0.3),
        Ellipsoid((0.3, 0.4, 0.3), 1.0, centre=(0.6, 0.1, 0.1)),
        Ellipsoid((0.25, 0.25, 0.35), 1.2, centre=(-0.5, -0.4, -0.1)),
    )
)
TRUTH = PHANTOM.attenuation(GRID)


@pytest.fixture(scope="module")
def data() -> np.ndarray:
    detector = Detector.centred(SHAPE, PITCH)
    return np.stack([PHANTOM.line_integrals(a, detector) for a in ANGLES]).astype(np.float32)


def _grown(data: np.ndarray, steps: float, views: int = 48) -> StreamingFit:
    """A fit that takes so many steps between two views in order."""
    fit, owed = StreamingFit(VIEWS, GRID, gaussians=800, now=SteppedClock(tick=1.0)), 0.0
    for view in range(views):
        fit.add_views(data[view : view + 1], ANGLES[view : view + 1])
        owed += steps
        if owed >= 1:
            fit.advance(int(owed))
            owed -= int(owed)
    return fit


def test_the_errors_along_all_views_are_the_error_of_the_volume() -> None:
    """Parseval's theorem on lines through the origin, whose density falls as 1 / |ω|."""
    angles = np.linspace(0, np.pi, 90, endpoint=False)
    views = Geometry.parallel(angles, (1, 64), pixel_pitch=1.0)
    grid = Grid.matching(views)
    _, y, x = np.indices(grid.shape) - 31.5

    def blob(at: float, width: float) -> NDArray[np.float32]:
        return np.exp(-((x - at) ** 2 + (y + at / 2) ** 2) / (2 * width**2)).astype(np.float32)

    one, other = blob(5, 4) + blob(-9, 3), blob(5, 5) + np.float32(0.7) * blob(-9, 3)
    projector = Projector(views, grid)
    seen = [projector.forward(volume)[:, 0] for volume in (other, one)]
    expected = np.linalg.norm(other - one) / np.linalg.norm(one)
    assert volume_error(*seen) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("views", [24, 48])
@pytest.mark.parametrize(("steps", "direct"), others_slow([(0.05, True), (12, False)]))
def test_the_better_of_the_fit_and_fbp_is_shown(data: np.ndarray, steps: float, views: int, direct: bool) -> None:
    fit = _grown(data, steps, views)
    shown, of_fit = fit.best_preview(), fit.snapshot()
    by_fbp = direct_volume(list(data[:views]), VIEWS.select(range(views)), GRID)
    assert shown.direct == direct == (psnr(TRUTH, by_fbp) > psnr(TRUTH, of_fit.data))
    np.testing.assert_allclose(shown.volume.data, by_fbp if direct else of_fit.data, atol=1e-4)


def test_views_that_fbp_does_not_take_are_not_compared() -> None:
    cone = Geometry.cone([0.0, 1.0, 2.0], SHAPE, pixel_pitch=PITCH, sod=50.0, sdd=100.0)
    view = np.ones(SHAPE, np.float32)
    for geometry, held_out in ((cone, [1]), (VIEWS.select(range(3)), [])):
        errors = PredictionErrors.of([view] * 3, geometry, held_out, lambda number: view)
        assert np.isnan(errors.fit) and np.isnan(errors.direct)


@pytest.mark.slow
def test_the_end_is_the_same_however_long_the_fit_had_to_wait(data: np.ndarray) -> None:
    """A fit whose processor was busy has the steps that it missed in its last round; 0.1 dB apart."""

    def quality(steps: float) -> float:
        fit = _grown(data, steps)
        last = FinalFit(fit, R2(), 1e9, 0.0)
        made = last.run(ReconProblem(Views(data, VIEWS), GRID), RunControl(now=SteppedClock(tick=1e-3)))
        assert made.history[-1].step == made.history[-1].steps
        return psnr(TRUTH, made.volume.data)

    busy, quiet = quality(0.05), quality(12)
    assert abs(busy - quiet) < 0.3
