"""StreamingFit: projections one by one give the same quality as all at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import recon
from recon import Geometry, Grid
from recon.assess.metrics import psnr
from recon.base.kernel import Kernel
from recon.splatting.anytime import WHILE_VIEWS_COME
from recon.splatting.initialise import count_for, joined_for
from recon.splatting.settings import DensityPolicy, FitSettings
from recon.splatting.stream import StreamingFit
from recon.splatting.stream_states import Growing
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid
from tests.clock import SteppedClock
from tests.messages import refused

SHAPE, PITCH = (24, 36), 0.1
ANGLES = np.linspace(0, np.pi, 40, endpoint=False)
VIEWS = Geometry.parallel(ANGLES, SHAPE, pixel_pitch=PITCH)
GRID = Grid.matching(VIEWS)


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    return Phantom.of(
        (
            Cylinder(1.4, 1.8, 0.3),
            Ellipsoid((0.3, 0.4, 0.3), 1.0, centre=(0.6, 0.1, 0.2)),
            Ellipsoid((0.25, 0.25, 0.35), 1.2, centre=(-0.5, -0.4, -0.2)),
            Ellipsoid((0.2, 0.3, 0.2), 0.8, centre=(-0.1, 0.7, 0.1)),
        )
    )


@pytest.fixture(scope="module")
def data(phantom: Phantom) -> np.ndarray:
    detector = Detector.centred(SHAPE, PITCH)
    return np.stack([phantom.line_integrals(a, detector) for a in ANGLES]).astype(np.float32)


def _stream(data: np.ndarray, order: np.ndarray, seed: int = 0) -> StreamingFit:
    model = StreamingFit(VIEWS, GRID, seed, gaussians=800, now=SteppedClock(tick=0.01))
    for view in order:
        model.add_views(data[view : view + 1], ANGLES[view : view + 1])
        model.advance(0.1)
    return model


SCATTERED = np.argsort((np.arange(40) * 0.618) % 1)


@pytest.fixture(scope="module")
def streamed(data: np.ndarray, phantom: Phantom) -> tuple[np.ndarray, float]:
    """The volume of all views in that order before its last steps, and its PSNR in dB after them."""
    model = _stream(data, SCATTERED)
    volume = model.snapshot().data.copy()
    model.finish(2.0)
    return volume, psnr(phantom.attenuation(GRID), model.snapshot().data)


def test_the_volume_grows_with_the_views_and_ends_well(data: np.ndarray, phantom: Phantom) -> None:
    truth = phantom.attenuation(GRID)
    model = StreamingFit(VIEWS, GRID, 0, gaussians=800, now=SteppedClock(tick=0.01))
    quality = []
    for view in range(40):
        model.add_views(data[view : view + 1], ANGLES[view : view + 1])
        model.advance(0.1)
        if view in (19, 39):
            quality.append(psnr(truth, model.snapshot().data))
    end = model.finish(3.0)
    quality.append(psnr(truth, model.snapshot().data))
    assert quality[0] < quality[1] < quality[2]
    assert quality[2] > 27
    assert end.n_views == 40 and end.residual < 0.05


def test_pixels_that_measured_nothing_have_no_weight(data: np.ndarray, phantom: Phantom) -> None:
    """A post in the beam of every third view: its columns are NaN, or filled."""
    truth, unseen, quality = phantom.attenuation(GRID), data.copy(), []
    unseen[::3, :, 12:20] = np.nan
    for views in (unseen, np.nan_to_num(unseen)):
        model = StreamingFit(VIEWS, GRID, 0, gaussians=800, now=SteppedClock(tick=0.01))
        for first in range(0, 40, 10):
            model.add_views(views[first : first + 10], ANGLES[first : first + 10])
            model.replace_newest(views[first + 9])
            model.advance(0.1)
        model.replace_views(views)
        assert np.isfinite(model.unlearnt)
        model.finish(0.3)
        quality.append(psnr(truth, model.snapshot().data))
    assert quality[0] > quality[1] + 3
    with refused(ValueError):
        model.add_views(np.full((1, *SHAPE), np.nan, np.float32), ANGLES[:1])


@pytest.mark.slow
def test_the_same_seed_gives_the_same_volume(data: np.ndarray, streamed: tuple[np.ndarray, float]) -> None:
    np.testing.assert_array_equal(_stream(data, SCATTERED).snapshot().data, streamed[0])


@pytest.mark.slow
def test_a_method_streams_with_its_own_settings(data: np.ndarray, phantom: Phantom) -> None:
    mine: dict[str, Any] = {"loss": "poisson", "kernel": Kernel.GAUSSIAN, "views_per_step": 3}
    method = recon.R2(gaussians=800, fit=FitSettings(**mine))
    model = method.stream(VIEWS, 0, SteppedClock(tick=0.01))
    assert model.settings == replace(WHILE_VIEWS_COME, **mine)
    assert recon.R2().stream(VIEWS, 0, SteppedClock(tick=0.01)).settings == WHILE_VIEWS_COME
    for first in range(0, 40, 8):
        model.add_views(data[first : first + 8], ANGLES[first : first + 8])
        model.advance(0.5)
    model.finish(2.0)
    found = model.gaussians
    assert found is not None and found.kernel is Kernel.GAUSSIAN
    assert psnr(phantom.attenuation(GRID), model.snapshot().data) > 20
    with pytest.raises(ValueError, match="leave joined_pixels out"):
        recon.R2(fit=FitSettings(joined_pixels=2)).stream(VIEWS, 0, SteppedClock(tick=0.01))


def test_it_waits_for_views_that_are_apart(data: np.ndarray) -> None:
    model = StreamingFit(VIEWS, GRID, first_views=4, first_span=np.pi / 4, gaussians=500, now=SteppedClock(tick=0.01))
    model.add_views(data[:6], ANGLES[:6])  # six views over 22 degrees
    assert not model.started and model.advance(0.1).n_gaussians == 0
    assert not model.snapshot().data.any()
    model.add_views(data[20:22], ANGLES[20:22])
    assert model.advance(0.1).n_gaussians > 0 and model.started


def test_room_for_gaussians_comes_with_the_views(data: np.ndarray) -> None:
    greedy = FitSettings(policy=DensityPolicy(start=0, every=1, threshold=0, prune_below=0))
    model = StreamingFit(VIEWS, GRID, 0, gaussians=500, settings=greedy, now=SteppedClock(tick=0.01))
    counts = []
    for first, last in ((0, 16), (16, 24), (24, 36)):  # each half as many again
        model.add_views(data[first:last], ANGLES[first:last])
        counts.append(model.advance(0.3).n_gaussians)
    assert counts == [625, 750, 750]
    assert model.finish(0.3).n_gaussians == 750


@pytest.mark.slow
@pytest.mark.parametrize("offset", [1e-5, -1e-5])
def test_views_without_a_sample_at_the_start_are_got_over(data: np.ndarray, phantom: Phantom, offset: float) -> None:
    # Noise alone gives no model, or, where it is positive, one whose scale says nothing of the sample.
    model = StreamingFit(VIEWS, GRID, 0, gaussians=800, now=SteppedClock(tick=0.01))
    for view, angle in enumerate(np.linspace(0, 1, 10)):
        noise = np.random.default_rng(view).normal(offset, 1e-5, (1, *SHAPE)).astype(np.float32)
        model.add_views(noise, [angle])
        model.advance(0.05)
    assert model.started == (offset > 0)
    model.add_views(data, ANGLES)
    model.advance(0.1)
    end = model.finish(3.0)
    assert end.n_views == 50
    assert psnr(phantom.attenuation(GRID), model.snapshot().data) > 15


def test_bad_views_are_refused_and_leave_the_model_alone(data: np.ndarray) -> None:
    model = StreamingFit(VIEWS, GRID, gaussians=500)
    with refused(ValueError):
        model.add_views(data[:2], ANGLES[:3])
    bad = data[:1].copy()
    bad[0, 3, 3] = np.inf
    with refused(ValueError):
        model.add_views(bad, ANGLES[:1])
    with refused(ValueError):
        model.add_views(np.full((1, *SHAPE), 1e300), ANGLES[:1])
    assert model.n_views == 0
    with refused(ValueError):
        StreamingFit(VIEWS, GRID, gaussians=0)
    with refused(ValueError):
        model.finish(0.1)


def test_the_newest_view_may_be_replaced(data: np.ndarray) -> None:
    model = StreamingFit(VIEWS, GRID, gaussians=500, now=SteppedClock(tick=0.01))
    for first, last in ((0, 5), (5, 21), (21, 22)):  # before and after there is a model
        model.add_views(data[first:last], ANGLES[first:last])
        model.replace_newest(data[last - 1] + 1)
        model.replace_newest(data[last - 1])
        model.advance(0.0)
    assert isinstance(model._stage, Growing) and model.n_views == 22
    np.testing.assert_allclose(model._stage.problem.projections, data[:22], atol=1e-5)
    np.testing.assert_allclose(model._stage.problem.geometry.angles, ANGLES[:22])
    with refused(ValueError):
        StreamingFit(VIEWS, GRID).replace_newest(data[0])
    with refused(ValueError):
        model.replace_newest(np.full(SHAPE, np.nan, np.float32))


@pytest.mark.parametrize("views", [5, 20])
def test_a_cleared_fit_has_neither_projections_nor_a_model(data: np.ndarray, views: int) -> None:
    model = StreamingFit(VIEWS, GRID, gaussians=500, now=SteppedClock(tick=0.01))
    for _ in range(2):
        model.add_views(data[:views], ANGLES[:views])
        assert model.advance(0.0).n_views == views and model.started == (views == 20)
        model.clear()
        assert (model.n_views, model.n_unlearnt, model.started) == (0, 0, False)


def test_a_setting_that_would_do_nothing_is_refused() -> None:
    with refused(ValueError):
        StreamingFit(VIEWS, GRID, settings=FitSettings(joined_pixels=2))


@pytest.mark.slow
@pytest.mark.parametrize("marred", [3, 30])  # among the first views, and after the model has been placed
def test_one_wild_pixel_spoils_neither_earlier_nor_later_views(
    data: np.ndarray, phantom: Phantom, streamed: tuple[np.ndarray, float], marred: int
) -> None:
    views = data.copy()
    views[marred, 10, 17] = 1e30
    model = _stream(views, SCATTERED)
    with pytest.raises(ValueError, match="no usable value"):
        model.add_views(np.full((1, *SHAPE), 1e30, np.float32), [0.1])
    assert model.n_views == 40
    model.finish(2.0)
    assert psnr(phantom.attenuation(GRID), model.snapshot().data) > streamed[1] - 1.0


def test_a_template_whose_views_differ_is_refused_and_one_shift_is_kept(data: np.ndarray) -> None:
    for name, own in (("shifts", [[0, 0], [3, 0]]), ("roll", [0, 0.1]), ("tilt", [0, 0.1])):
        with pytest.raises(ValueError, match=f"{name} differ"):
            StreamingFit(Geometry.parallel([0, 1], SHAPE, pixel_pitch=PITCH, **{name: own}), GRID)  # type: ignore[arg-type]
    # An axis elsewhere and the same shift of all views are one thing.
    told = Geometry.parallel([0.0], SHAPE, pixel_pitch=PITCH, axis_col=VIEWS.axis_col - 5, shifts=[[5, 0]])
    found = []
    for template in (VIEWS, told):
        model = StreamingFit(template, GRID, gaussians=500, now=SteppedClock(tick=0.01))
        model.add_views(data[:20], ANGLES[:20])
        model.advance(0.1)
        model.add_views(data[20:], ANGLES[20:])
        model.advance(0.3)
        found.append(model.snapshot().data)
    np.testing.assert_allclose(found[1], found[0], atol=1e-3 * float(found[0].max()))


def test_an_axis_outside_the_detector_is_refused() -> None:
    with refused(ValueError):
        StreamingFit(Geometry.parallel([0.0], (8, 64), axis_col=400.0))


def test_the_count_follows_the_grid() -> None:
    assert count_for(Grid((4, 4, 4)), cone=False) == 2000
    assert count_for(Grid((100, 200, 200)), cone=False) == pytest.approx(np.pi / 4 * 4e6 / 60, rel=0.01)
    assert count_for(Grid((2048, 2048, 2048)), cone=False) == 200_000


def test_the_count_of_a_cone_grows_with_the_area_of_its_field() -> None:
    small, large = Grid((100, 100, 100)), Grid((200, 200, 200))
    assert count_for(large, cone=True) == pytest.approx(4 * count_for(small, cone=True), rel=1e-3)
    assert count_for(Grid((20, 20, 20)), cone=True) == 2000


def test_pixels_are_joined_as_gaussians_are_wider() -> None:
    """Eight times too few Gaussians for the volume are twice as wide; a cone's, which cover surfaces, four times."""
    field, detector = Grid((160, 448, 448)), (160, 448)  # at most 420 000 Gaussians by the rule
    usual = np.pi / 4 * 160 * 448**2 / 60
    assert [joined_for(field, False, round(usual / n), detector) for n in (1, 7, 9, 26, 28)] == [1, 1, 2, 2, 3]
    surface = (160 * 448**2) ** (2 / 3)
    assert [joined_for(field, True, round(surface / n), detector) for n in (1, 3, 5, 10)] == [1, 1, 2, 3]
    assert joined_for(field, False, 10, (1, 448)) == 1 and joined_for(field, False, 10, (8, 448)) == 2


def test_a_model_moves_with_its_axis_to_where_the_views_have_it(data: np.ndarray, phantom: Phantom) -> None:
    """Half a circle of views about an axis that is off by d shows the sample off by 4 d / π across its middle."""
    truth, off = phantom.attenuation(GRID), 0.8
    wrong = Geometry.parallel(ANGLES, SHAPE, pixel_pitch=PITCH, axis_col=VIEWS.axis_col + off)
    model = StreamingFit(wrong, GRID, 0, gaussians=800, now=SteppedClock(tick=0.01))
    model.add_views(data, ANGLES)
    model.advance(2.0)
    before, quality = model.gaussians, psnr(truth, model.snapshot().data)
    model.move_axis(VIEWS.axis_col)
    after = model.gaussians
    assert before is not None and after is not None
    expected = (0.0, off * PITCH * 4 / np.pi, 0.0)
    np.testing.assert_allclose((after.means - before.means).numpy(), np.tile(expected, (after.n, 1)), atol=0.1 * PITCH)
    assert psnr(truth, model.snapshot().data) > quality + 3


def _disturbed(data: np.ndarray, truth: np.ndarray, batches: list[np.ndarray], axis_off: float = 0.0) -> float:
    """PSNR in dB of a stream of these batches of views, whose axis is corrected once half of the views are there."""
    template = Geometry.parallel(ANGLES, SHAPE, pixel_pitch=PITCH, axis_col=VIEWS.axis_col + axis_off)
    model = StreamingFit(template, GRID, 0, gaussians=800, now=SteppedClock(tick=0.01))
    for batch in batches:
        model.add_views(data[batch], ANGLES[batch])
        model.advance(0.1)
        if model.n_views == 20 and axis_off:
            model.move_axis(VIEWS.axis_col)
    model.finish(8.0)
    return psnr(truth, model.snapshot().data)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_views_out_of_order_and_a_restart_in_mid_scan_cost_less_than_a_third_of_a_decibel(
    data: np.ndarray, phantom: Phantom
) -> None:
    truth, in_order = phantom.attenuation(GRID), np.arange(40)
    disturbed = {
        "golden-ratio order": np.split(np.argsort(in_order * 0.618 % 1).argsort(), 40),
        "random order": np.split(np.random.default_rng(0).permutation(40), 40),
        "restarted": [in_order[:20], *np.split(in_order[20:], 20)],
    }
    found = {name: _disturbed(data, truth, batches) for name, batches in disturbed.items()}
    assert min(found.values()) > _disturbed(data, truth, np.split(in_order, 40)) - 0.3, found


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_another_axis_in_mid_scan_costs_less_than_a_third_of_a_decibel(data: np.ndarray, phantom: Phantom) -> None:
    truth, batches = phantom.attenuation(GRID), np.split(np.arange(40), 40)
    found = {off: _disturbed(data, truth, batches, off) for off in (0.1, 0.3, -0.8)}
    assert min(found.values()) > _disturbed(data, truth, batches) - 0.3, found


def test_a_model_of_other_views_is_placed_anew(data: np.ndarray) -> None:
    model = StreamingFit(VIEWS, GRID, 0, gaussians=500, now=SteppedClock(tick=0.01))
    shut = data.copy()
    shut[:8] = 0
    model.add_views(shut, ANGLES)
    model.advance(0.1)
    model.replace_views(data)
    assert not model.started
    model.advance(0.1)
    model.replace_views(np.float32(1.02) * data)
    assert model.started
