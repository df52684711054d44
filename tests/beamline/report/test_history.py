"""The record of a fit is written to a file and read again; the residual in held-out projections judges it."""

import numpy as np
import pytest

from beamline.report.history import (
    history_arrays,
    history_from,
    residual_curve,
)
from recon.base.method import Progress

pytestmark = pytest.mark.usefixtures("real_pictures")


def _record(slope: float, n: int = 60, views: int = 12) -> tuple[Progress, ...]:
    """Falls by `slope` dB for each factor of e in time."""
    times = np.linspace(0.5, 30, n)
    residuals = 10 ** (-(20 + slope * np.log(times)) / 20)
    pairs = zip(times.tolist(), residuals.tolist(), strict=True)
    return tuple(Progress(k + 1, n, t, r / 2, r, 100, views) for k, (t, r) in enumerate(pairs))


def test_there_and_back() -> None:
    history = _record(3.0)
    arrays = history_arrays(history)
    assert {len(values) for values in arrays.values()} == {len(history)}
    assert [p.step for p in history_from(arrays)] == [p.step for p in history]
    np.testing.assert_array_equal(history_arrays(history_from(arrays))["residual"], arrays["residual"])
    assert history_arrays(()) == {} and history_from({}) == ()


def test_views_held_out_judge_before_views_used() -> None:
    seconds = np.arange(3.0)

    def words(**arrays: np.ndarray) -> str | None:
        judged = residual_curve({"seconds": seconds, **arrays})
        return None if judged is None else judged.views

    assert words(residual=seconds, held_out=seconds) == "held-out projections"
    assert words(residual=seconds, held_out=np.full(3, np.nan)) == "projections used"
    assert words() is None


def test_each_look_at_views_held_out_counts_once() -> None:
    """Between two looks the record says the last one again, which is no evidence."""
    looks = np.array([np.nan, np.nan, 0.5, 0.5, 0.5, 0.4, 0.4, 0.3])
    judged = residual_curve({"seconds": np.arange(8.0), "residual": looks, "held_out": looks})
    assert judged is not None
    np.testing.assert_array_equal(judged.seconds, [2, 5, 7])
    np.testing.assert_array_equal(judged.residuals, [0.5, 0.4, 0.3])
