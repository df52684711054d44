"""The trade-off's table in words, CSV, JSON and on a page: the same figures everywhere, and conclusions that add up."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from beamline.core.machine import machine
from beamline.features.trials.front import TRADEOFF, conclusions
from beamline.features.trials.layout import finite, text, to_csv, to_html, write_page, write_table
from beamline.features.trials.plans import plan, plan_in_equal_time
from beamline.features.trials.table import TrialTable
from beamline.features.trials.trial import Outcome, Trial
from beamline.report.html import Picture
from beamline.report.sheets import SliceSheet
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
    assert table.qualities == [pytest.approx(20.0)]
    assert "−20 log₁₀ of the held-out residual" in conclusions(table)[1]
    row = next(line for line in text(table, TRADEOFF).splitlines() if line.startswith("* fbp"))
    assert row.split()[-4:] == ["1.00", "n/a", "n/a", "0.1000"]  # s, CPU s, MB, residual: two are not known


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


def test_what_is_not_finite_is_nothing() -> None:
    assert finite({"a": [1, math.nan, (math.inf, "x")], 2: None}) == {"a": [1, None, [None, "x"]], "2": None}
