"""Tables of trials as text, CSV, page and pictures."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from beamline.core.machine import machine
from beamline.features.trials import front as tradeoff_figures
from beamline.features.trials.front import TRADEOFF, colour_of, conclusions, cost_curves, pareto_plot
from beamline.features.trials.layout import text, to_csv, to_html, write_page, write_table
from beamline.features.trials.tradeoff import plan, plan_in_equal_time
from beamline.features.trials.trial import Outcome, Trial, TrialTable
from beamline.report.html import Picture
from beamline.report.sheets import SliceSheet
from recon import methods
from recon.methods import names_of_one_volume
from tests.beamline.html_page import parsed_page

BASE = Trial("method", "fbp", 10)
FIT = Trial("method", "r2", 10, settings={"steps": 100, "gaussians": 2000})


def _table(*outcomes: Outcome, by: str = "psnr") -> TrialTable:
    return TrialTable(outcomes, by, "mm", machine(), {"file": "a <b>.h5"}, "beamline tradeoff 'a <b>.h5'")


def _done(trial: Trial, seconds: float, psnr: float, memory: int | None = 10**8) -> Outcome:
    return Outcome(trial, "done", seconds, memory, {"psnr": psnr, "ssim3d": 0.5})


@pytest.mark.parametrize("kind", ["quick", "full", "equal"])
def test_the_table_fits_into_120_columns(kind: str) -> None:
    """Also with four-digit numbers of views, and with everything that can be measured."""
    metrics = {"psnr": 29.12, "ssim3d": 0.7474, "residual_held_out": 0.01784, "resolution": 0.6221}
    if kind == "equal":
        del metrics["resolution"]  # halves are not made in equal time
    planned = {
        "quick": plan(names_of_one_volume(), 1801, 200_000, "quick"),
        "full": plan(names_of_one_volume(), 1801, 200_000, "full"),
        "equal": plan_in_equal_time(names_of_one_volume(), 1801, 200_000, 3600.0),
    }
    outcomes = tuple(
        Outcome(trial, "done", 12345.6, int(4e10), metrics, cpu_seconds=98765.4, reached="12345 iterations")
        for trial in planned[kind]
    )
    said = text(TrialTable(outcomes, "psnr", "mm", machine(), {}, ""), TRADEOFF)
    rows = said.split("\n\n")[1].splitlines()[1:]
    assert len(rows) == len(outcomes)
    assert max(map(len, said.splitlines()[1:])) <= 120  # the first line is the machine's
    head = next(line for line in said.splitlines() if line.startswith("  trial"))
    assert ("reached" in head) == (kind == "equal")
    assert {len(row.replace("  12345 iterations", "  reached")) for row in rows} == {len(head)}
    assert all(" 12346 " in row and " 40000 " in row for row in rows)


def test_each_further_decibel_is_told_with_its_price() -> None:
    worse = replace(FIT, group="steps", settings={**FIT.settings, "steps": 50})
    table = _table(_done(BASE, 2.0, 20.0), _done(FIT, 12.0, 24.0), _done(worse, 13.0, 23.0))
    pick, quality, fastest, step = conclusions(table)
    assert pick == "Best for its time: r2, 10 views, 100 steps, 2k Gaussians: 24.00 dB in 12 s."
    assert quality == "Quality: PSNR, dB."
    assert fastest == "Fastest: fbp, 10 views: 20.00 dB in 2 s."
    assert step == "+4.00 dB for 10 s more (2.5 s a dB): r2, 10 views, 100 steps, 2k Gaussians."
    near = _done(worse, 4.0, 23.6)
    assert conclusions(_table(_done(BASE, 2.0, 20.0), _done(FIT, 12.0, 24.0), near))[0] == (
        "Best for its time: r2, 10 views, 50 steps, 2k Gaussians: 23.60 dB in 4 s; the best of all "
        "(r2, 10 views, 100 steps, 2k Gaussians) has 0.40 dB more, for 8 s more."
    )
    with_halves = replace(_done(BASE, 2.0, 20.0), metrics={"psnr": 20.0, "resolution": 0.6})
    assert conclusions(_table(with_halves))[-1].startswith("FSC: a smaller period is better among settings of one")
    assert conclusions(_table())[-1] == "No trial has both a time and a quality."


def test_a_held_out_residual_is_told_in_decibels_below_the_data() -> None:
    judged = Outcome(BASE, "done", 1.0, None, {"residual_held_out": 0.1})
    table = _table(judged, by="residual_held_out")
    assert judged.quality(table.by) == pytest.approx(20.0)
    assert "−20 log₁₀ of the held-out residual" in conclusions(table)[1]
    row = next(line for line in text(table, TRADEOFF).splitlines() if line.startswith("* fbp"))
    assert row.split()[-4:] == ["1.00", "n/a", "–", "0.1000"]  # s, CPU s, MB, residual: two are not known


def test_csv_and_json_hold_what_was_measured_and_nothing_where_nothing_was(tmp_path: Path) -> None:
    table = _table(_done(BASE, 2.0, math.inf), Outcome(FIT, "failed", message='no "room", said\nthe system'))
    first, second = csv.DictReader(io.StringIO(to_csv(table, TRADEOFF)))
    assert (first["seconds"], first["psnr"], first["ssim3d"], first["steps"]) == ("2.0", "", "0.5", "")
    assert (second["status"], second["seconds"], second["gaussians"]) == ("failed", "", "2000")
    assert second["message"] == 'no "room", said\nthe system'
    write_table(tmp_path, table, TRADEOFF)
    record = json.loads((tmp_path / "tradeoff.json").read_text(encoding="utf-8"))
    assert [trial["metrics"].get("psnr") for trial in record["trials"]] == [None, None]
    assert record["trials"][1]["trial"]["label"] == FIT.label
    assert (tmp_path / "tradeoff.csv").read_text(encoding="utf-8") == to_csv(table, TRADEOFF)


def test_the_page_shows_words_of_others_as_words() -> None:
    page = to_html(_table(_done(BASE, 2.0, 20.0), Outcome(FIT, "failed", message="<script>")), TRADEOFF, [])
    assert "<script>" not in page and "&lt;script&gt;" in page
    assert "a <b>" not in page and "a &lt;b&gt;.h5" in page
    assert f"<strong>{BASE.label}</strong>" in page and f"<strong>{FIT.label}" not in page
    assert "1 of 2 trials" in page


def test_the_page_has_every_part_and_requests_nothing() -> None:
    done = _done(BASE, 2.0, 20.0)
    table = _table(done, Outcome(FIT, "failed", message="no room"))
    parsed = parsed_page(to_html(table, TRADEOFF, [Picture("Quality", "A <caption>", b"\x89PNG")]))
    text = " ".join("".join(parsed.text).split())
    assert all(line in text for line in conclusions(table))
    for part in ("What accuracy costs", "PSNR (dB)", BASE.label, "2.00", "failed: no room", "A <caption>", "a <b>.h5"):
        assert part in text
    assert text.count("beamline tradeoff 'a <b>.h5'") == 1


def test_pictures_are_of_what_there_is(tmp_path: Path) -> None:
    write_page(tmp_path, _table(Outcome(BASE, "failed")), TRADEOFF, SliceSheet())
    assert {path.name for path in tmp_path.iterdir()} == {"tradeoff.html"}
    curve = ((0.1, 3.0), (0.2, 4.0))
    write_page(
        tmp_path,
        _table(replace(_done(BASE, 2.0, 20.0, memory=None), curve=curve, curve_of="views used")),
        TRADEOFF,
        SliceSheet(),
    )
    assert {path.name for path in tmp_path.iterdir()} == {"tradeoff.html", "quality_seconds.png", "curves.png"}


FBP, FIGURES_FIT = Trial("method", "fbp", 10), Trial("method", "r2", 10, settings={"steps": 100})
FEW = Trial("views", "r2", 5, settings={"steps": 100})


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures in place of their pixels."""
    figures: list[Figure] = []
    monkeypatch.setattr(tradeoff_figures, "png", lambda figure: figures.append(figure) or b"")  # type: ignore[func-returns-value]
    return figures


def test_every_trial_is_a_point_and_the_front_a_line_through_its_own(drawn: list[Figure]) -> None:
    points = [(FBP, 1.0, 20.0), (FEW, 20.0, 19.0), (FIGURES_FIT, 30.0, 25.0), (FEW, math.nan, 30.0)]
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
        f"1  {FBP.label}: 20.00 dB, 1 s\n2  {FIGURES_FIT.label}: 25.00 dB, 30 s   (ring: best for its time)"
    )
    names = [label.get_text() for label in drawn[0].legends[0].get_texts()]
    assert names == ["fbp", "r2", "baseline", "fewer views"]


def test_what_is_far_below_the_best_is_counted_and_not_drawn(drawn: list[Figure]) -> None:
    pareto_plot([(FBP, 1.0, 2.0), (FEW, 1.2, 3.0), (FIGURES_FIT, 2.0, 25.0)], [2], "time (s)", "PSNR (dB)")
    axes = drawn[0].axes[0]
    assert axes.get_ylim()[0] == 13.0
    assert "2 more below 13.0 dB" in [note.get_text() for note in axes.texts]
    pareto_plot([(FBP, 1.0, 2.0), (FEW, 1.2, 1.0), (FIGURES_FIT, 2.0, 25.0)], [0, 2], "time (s)", "PSNR (dB)")
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
        for trial, views in ((FIGURES_FIT, "views held out"), (FBP, "views used"))
    )
    cost_curves([held, used])
    solid, dashed = drawn[0].axes[0].lines
    assert (solid.get_linestyle(), dashed.get_linestyle()) == ("-", "--")
    names = [label.get_text() for label in drawn[0].legends[0].get_texts()]
    assert names == ["r2 (views held out)", "fbp (views used)"]


def test_the_trial_that_a_number_names_lies_above_another_at_its_place(drawn: list[Figure]) -> None:
    """Whichever of them was drawn later."""
    points = [(FIGURES_FIT, 2.0, 25.0), (FBP, 2.0, 25.0), (FEW, 2.0, 25.0)]
    for front in range(3):
        pareto_plot(points, [front], "time (s)", "PSNR (dB)")
        dots = drawn[-1].axes[0].collections[:3]
        assert max(range(3), key=lambda k: dots[k].get_zorder()) == front


def test_every_method_has_a_colour_of_its_own_also_one_of_another_package(monkeypatch: pytest.MonkeyPatch) -> None:
    names = (*methods.names(), "theirs", "others")
    monkeypatch.setattr(tradeoff_figures, "names", lambda: names)
    assert len({colour_of(name) for name in names}) == len(names)
