"""Pictures of a trade-off: every trial a point, the front a line with numbers, and nothing drawn that is not said."""

from __future__ import annotations

import math

import numpy as np
import pytest
from matplotlib.figure import Figure

from beamline.features.trials import figures as tradeoff_figures
from beamline.features.trials.figures import colour_of, cost_curves, pareto_plot
from beamline.features.trials.trial import Outcome, Trial
from recon import methods

FBP, FIT = Trial("method", "fbp", 10), Trial("method", "r2", 10, settings={"steps": 100})
FEW = Trial("views", "r2", 5, settings={"steps": 100})


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures in place of their pixels."""
    figures: list[Figure] = []
    monkeypatch.setattr(tradeoff_figures, "png", lambda figure: figures.append(figure) or b"")  # type: ignore[func-returns-value]
    return figures


@pytest.mark.usefixtures("real_pictures")
def test_they_are_png() -> None:
    points = [(FBP, 1.0, 20.0), (FIT, 30.0, 25.0), (FEW, math.nan, 1.0)]
    assert pareto_plot(points, [0, 1], "time (s)", "PSNR (dB)").startswith(b"\x89PNG")
    assert pareto_plot([], [], "time (s)", "PSNR (dB)").startswith(b"\x89PNG")
    assert cost_curves([Outcome(FIT, "done", curve=[(1, 2), (2, 3)])]).startswith(b"\x89PNG")


def test_every_trial_is_a_point_and_the_front_a_line_through_its_own(drawn: list[Figure]) -> None:
    points = [(FBP, 1.0, 20.0), (FEW, 20.0, 19.0), (FIT, 30.0, 25.0), (FEW, math.nan, 30.0)]
    pareto_plot(points, [0, 2], "time (s)", "PSNR (dB)", "s", pick=1)
    axes = drawn[0].axes[0]
    places = [tuple(point) for dots in axes.collections for point in np.asarray(dots.get_offsets()).tolist()]
    assert places[:3] == [(1.0, 20.0), (20.0, 19.0), (30.0, 25.0)]  # what is not finite has no place
    assert places[3:] == [(30.0, 25.0)]  # the ring
    (line,) = axes.lines
    np.testing.assert_array_equal(np.asarray(line.get_data()), [[1.0, 30.0], [20.0, 25.0]])
    assert [(note.get_text(), note.xy) for note in axes.texts] == [("1", (1.0, 20.0)), ("2", (30.0, 25.0))]  # type: ignore[attr-defined]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time (s)", "PSNR (dB)")
    assert drawn[0].get_supxlabel() == (
        f"1  {FBP.label}: 20.00 dB, 1 s\n2  {FIT.label}: 25.00 dB, 30 s   (ring: best for its time)"
    )
    names = [label.get_text() for label in drawn[0].legends[0].get_texts()]
    assert names == ["fbp", "r2", "baseline", "fewer views"]


def test_what_is_far_below_the_best_is_counted_and_not_drawn(drawn: list[Figure]) -> None:
    pareto_plot([(FBP, 1.0, 2.0), (FEW, 1.2, 3.0), (FIT, 2.0, 25.0)], [2], "time (s)", "PSNR (dB)")
    axes = drawn[0].axes[0]
    assert axes.get_ylim()[0] == 13.0
    assert "2 more below 13.0 dB" in [note.get_text() for note in axes.texts]
    pareto_plot([(FBP, 1.0, 2.0), (FEW, 1.2, 1.0), (FIT, 2.0, 25.0)], [0, 2], "time (s)", "PSNR (dB)")
    assert drawn[1].axes[0].get_ylim()[0] == 1.5  # the front is whole


@pytest.mark.parametrize(
    ("costs", "scale"),
    [((1.0, 3.9), "linear"), ((1.0, 4.1), "log"), ((1e-3, 1e3), "log"), ((0.0, 9.0), "linear"), ((), "linear")],
)
def test_costs_far_apart_have_a_logarithmic_scale(drawn: list[Figure], costs: tuple[float, ...], scale: str) -> None:
    pareto_plot([(FBP, cost, 20.0) for cost in costs], [], "time (s)", "PSNR (dB)")
    assert drawn[0].axes[0].get_xscale() == scale


def test_a_curve_is_dashed_where_its_views_were_used(drawn: list[Figure]) -> None:
    curve = ((0.1, 3.0), (0.2, 4.0))
    held, used = (
        Outcome(trial, "done", curve=curve, curve_of=views)
        for trial, views in ((FIT, "views held out"), (FBP, "views used"))
    )
    cost_curves([held, used])
    solid, dashed = drawn[0].axes[0].lines
    assert (solid.get_linestyle(), dashed.get_linestyle()) == ("-", "--")
    names = [label.get_text() for label in drawn[0].legends[0].get_texts()]
    assert names == ["r2 (views held out)", "fbp (views used)"]


def test_the_trial_that_a_number_names_lies_above_another_at_its_place(drawn: list[Figure]) -> None:
    """Whichever of them was drawn later."""
    points = [(FIT, 2.0, 25.0), (FBP, 2.0, 25.0), (FEW, 2.0, 25.0)]
    for front in range(3):
        pareto_plot(points, [front], "time (s)", "PSNR (dB)")
        dots = drawn[-1].axes[0].collections[:3]
        assert max(range(3), key=lambda k: dots[k].get_zorder()) == front


def test_every_method_has_a_colour_of_its_own_also_one_of_another_package(monkeypatch: pytest.MonkeyPatch) -> None:
    names = (*methods.names(), "theirs", "others")
    monkeypatch.setattr(tradeoff_figures, "names", lambda: names)
    assert len({colour_of(name) for name in names}) == len(names)
