"""A fit's record goes into a file and comes back; the residual that judges it is that of views held out, if any."""

import math
from dataclasses import replace

import numpy as np
import pytest

from beamline.report.record import (
    history_arrays,
    history_from,
    price_of_decibel,
    price_text,
    quality_against_time,
    residual_curve,
)
from recon.assess.time_model import next_decibel, next_decibel_of_fit
from recon.base.method import Progress, Reconstruction
from recon.base.volume import Grid, Volume
from recon.splatting.anytime import WHILE_VIEWS_COME
from recon.splatting.settings import FitSettings

pytestmark = pytest.mark.usefixtures("real_pictures")

GRID = Grid((1, 1, 1))


def _record(slope: float, n: int = 60, views: int = 12) -> tuple[Progress, ...]:
    """Falls by `slope` dB for each factor of e in time."""
    times = np.linspace(0.5, 30, n)
    residuals = 10 ** (-(20 + slope * np.log(times)) / 20)
    pairs = zip(times.tolist(), residuals.tolist(), strict=True)
    return tuple(Progress(k + 1, n, t, r / 2, r, 100, views) for k, (t, r) in enumerate(pairs))


def _made(history: tuple[Progress, ...], method: str = "sirt") -> Reconstruction:
    settings = {"pace": FitSettings().pace} if method == "r2" else {}
    return Reconstruction(Volume(np.zeros(GRID.shape, np.float32), GRID), settings, history, method=method, seconds=1.0)


def test_there_and_back() -> None:
    history = _record(3.0)
    arrays = history_arrays(history)
    assert {len(values) for values in arrays.values()} == {len(history)}
    assert [p.step for p in history_from(arrays)] == [p.step for p in history]
    np.testing.assert_array_equal(history_arrays(history_from(arrays))["residual"], arrays["residual"])
    assert history_arrays(()) == {} and history_from({}) == ()


def test_what_was_not_recorded_is_not_a_number() -> None:
    arrays = history_arrays(_record(3.0))
    del arrays["loss"]
    assert all(math.isnan(p.loss) for p in history_from(arrays))


def test_views_held_out_judge_before_views_used() -> None:
    seconds = np.arange(3.0)

    def words(**arrays: np.ndarray) -> str | None:
        judged = residual_curve({"seconds": seconds, **arrays})
        return None if judged is None else judged.views

    assert words(residual=seconds, held_out=seconds) == "views held out"
    assert words(residual=seconds, held_out=np.full(3, np.nan)) == "views used"
    assert words() is None


def test_each_look_at_views_held_out_counts_once() -> None:
    """Between two looks the record says the last one again, which is no evidence."""
    looks = np.array([np.nan, np.nan, 0.5, 0.5, 0.5, 0.4, 0.4, 0.3])
    judged = residual_curve({"seconds": np.arange(8.0), "residual": looks, "held_out": looks})
    assert judged is not None
    np.testing.assert_array_equal(judged.seconds, [2, 5, 7])
    np.testing.assert_array_equal(judged.residuals, [0.5, 0.4, 0.3])


def test_a_fit_says_what_longer_fits_gained() -> None:
    made = _made(_record(3.0), "r2")
    assert price_of_decibel(made) == next_decibel_of_fit(30.0, 60)
    assert "as longer fits did on four other scans" in price_text(made)
    late = tuple(replace(p, step=10**6 + p.step) for p in _record(3.0))
    followed = replace(
        _made(_record(3.0), "r2"), settings={"pace": WHILE_VIEWS_COME.pace, "decay": WHILE_VIEWS_COME.decay}
    )
    assert price_of_decibel(followed) is None and price_text(followed) == ""
    assert (
        price_text(_made(late, "r2"))
        == "A longer reconstruction would hardly bring the volume 1 dB nearer to the sample"
    )


def test_iterations_say_what_another_decibel_would_cost() -> None:
    made = _made(_record(3.0))
    price = price_of_decibel(made)
    assert price is not None and price.seconds == pytest.approx(30 * math.expm1(1 / 3), rel=0.02)
    assert price_text(made).startswith("About 11.9 s more would lower the misfit to the views by 1 dB (")
    assert "would hardly lower the misfit" in price_text(_made(_record(0.0)))
    assert price_of_decibel(_made(())) is None and price_text(_made(())) == ""


def test_while_views_still_come_nothing_is_extrapolated() -> None:
    grown = (*_record(3.0), *_record(3.0, views=20))
    assert price_of_decibel(_made(grown)) is None


@pytest.mark.parametrize("slope", [3.0, 0.0])
def test_the_picture_has_room_for_all_of_it(slope: float) -> None:
    arrays = history_arrays(_record(slope))
    arrays["held_out"] = 1.3 * arrays["residual"]
    arrays["n_gaussians"][30:] *= 2
    further = next_decibel(arrays["seconds"], arrays["held_out"])
    assert quality_against_time(arrays, further).startswith(b"\x89PNG")
