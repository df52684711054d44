"""`beamline sweep`: values of options, slices, scores."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.features.trials import run_trial
from beamline.features.trials.sweep import UnseenViews, scores_of, shares_of
from beamline.features.trials.sweep_command import sweepable, swept_option
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.voxels.direct import direct
from recon.voxels.projector import Projector
from recon.voxels.resolution import ViewResolution, at_voxel_resolution
from tests.beamline.cli.small_scan import SCAN, beamline, left

pytestmark = pytest.mark.usefixtures("one_thread")
PNG = b"\x89PNG"


def _table(folder: str = "scan_sweep") -> list[dict[str, str]]:
    with (Path(folder) / "sweep.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_the_score_is_what_a_volume_leaves_of_views_that_it_has_not_seen(folder: Path) -> None:
    result = beamline("sweep", "scan.h5", "filter=ram-lak,hann", "--axis", "20.7", "--air", "none", "--json")
    assert result.exit_code == 0, result.output
    assert left(folder) == {"scan.h5", "scan_sweep"}
    assert left(folder / "scan_sweep") == {"sweep.csv", "report.html", "slices.png", "quality.png"}
    assert Path("scan_sweep/slices.png").read_bytes().startswith(PNG)
    done = json.loads(result.stdout.splitlines()[-1])
    expected = {}
    lines = SCAN.line_integrals().astype(np.float32)[:, :1]
    held = np.unique((np.arange(3) + 0.5) * 30 // 3).astype(int)  # one of eight of 30
    used = np.setdiff1d(np.arange(30), held)
    geometry = Geometry.parallel(SCAN.angles, (1, 40), axis_col=20.7, pixel_pitch=0.5)
    for name in ("ram-lak", "hann"):
        views = geometry.select(used)
        volume = direct(lines[used], views, Grid.matching(views), name)
        projector = Projector(geometry.select(held), Grid.matching(views))
        seen = at_voxel_resolution(lines[held].swapaxes(1, 2), projector.resolution).swapaxes(1, 2)
        off = projector.forward(volume) - seen
        expected[name] = np.linalg.norm(off) / np.linalg.norm(lines[held])
    table = {row["filter"]: float(row["residual_held_out"]) for row in _table()}
    assert table == pytest.approx(expected, rel=0.03)  # counts are whole numbers
    assert done["scores"] == pytest.approx(list(table.values()), rel=1e-4)
    assert done["best"] == {"filter": min(table, key=lambda name: table[name])}


def test_the_axis_is_found_by_slices_of_fbp(folder: Path) -> None:
    result = beamline("sweep", "scan.h5", "axis=17.2:24.2:0.5", "--json")
    done = json.loads(result.stdout.splitlines()[-1])
    assert float(done["best"]["axis"]) == pytest.approx(SCAN.axis_col, abs=0.01), result.stderr
    result = beamline("sweep", "scan.h5", "axis=30:50:5", "-o", "outside")
    assert result.exit_code == 2 and "outside the detector" in result.stderr


def test_a_grid_of_two_options_finds_the_axis_with_a_method_that_explains_views(folder: Path) -> None:
    given = ("sweep", "scan.h5", "axis=19.7:21.7:1", "iterations=5,15", "-m", "sirt", "-o", "grid")
    result = beamline(*given)
    assert result.exit_code == 0, result.output
    verdicts = {(row["axis"], row["iterations"]): row["verdict"] for row in _table("grid")}
    assert [at for at, verdict in verdicts.items() if verdict == "best"] == [("20.7", "15")]
    assert "beamline recon scan.h5 -m sirt --axis=20.7 --iterations=15" in result.stderr
    assert "The best iterations" not in result.stdout and "axis 20.7, iterations 15" in result.stdout


@pytest.mark.parametrize("slices", [0, 2])
def test_an_interrupt_keeps_the_slices_that_are_done(
    folder: Path, monkeypatch: pytest.MonkeyPatch, slices: int
) -> None:
    original, calls = vars(run_trial)["run_on"], iter(range(9))

    def interrupted(*args: Any) -> Any:
        if next(calls) == slices:
            raise KeyboardInterrupt
        return original(*args)

    monkeypatch.setattr(run_trial, "run_on", interrupted)
    result = beamline("sweep", "scan.h5", "filter=hann,ram-lak,shepp-logan")
    if not slices:
        assert result.exit_code == 130 and left(folder) == {"scan.h5"}
        return
    assert result.exit_code == 4 and "after 2 of 3 trials" in result.stderr
    assert [row["status"] for row in _table()] == ["done", "done", "interrupted"]


def test_values_that_change_pixels_have_no_score(folder: Path) -> None:
    result = beamline("sweep", "scan.h5", "bin=1,2", "--axis", "20.7")
    assert (
        result.exit_code == 0
        and "The table has no scores, because the values of this option change the pixels" in result.stdout
    )
    assert [(row["status"], row["residual_held_out"], row["verdict"]) for row in _table()] == [("done", "", "")] * 2
    assert Path("scan_sweep/slices.png").read_bytes().startswith(PNG)


def _unseen(model: float, value: float, ids: tuple[int, int] = (1, 5), views: str = "") -> UnseenViews:
    """A volume that shows so much in views held out of this value."""
    geometry = Geometry.parallel(np.array([0.0, 1.0]), (1, 4), axis_col=1.5, pixel_pitch=1.0)
    data, shown = (np.full((2, 4, 1), each, np.float32) for each in (value, model))
    resolution = ViewResolution.of(geometry, Grid.matching(geometry))
    return UnseenViews(np.array(ids), data, shown, resolution, views)


def test_a_correction_that_agrees_with_itself_alone_does_not_win() -> None:
    """Two of three corrections give views of 1, and the third, which takes half of them away, predicts its own best."""
    views = {"a": _unseen(1.02, 1.0, views="a"), "b": _unseen(1.01, 1.0, views="b"), "c": _unseen(0.5, 0.5, views="c")}
    scores = scores_of(views)
    assert scores is not None and not scores[1]
    assert shares_of(scores[0]) == pytest.approx([0.56 / 2.5, 0.53 / 2.5, 1.0 / 2.5], rel=1e-5)
    assert scores[0].verdicts == ["", "best", ""]


def test_only_views_that_no_slice_has_learnt_from_count() -> None:
    scores = scores_of({"a": _unseen(1.5, 1.0), "b": _unseen(1.2, 1.0, (5, 9), "b")})
    assert scores is not None and len(scores[0].predictions[0].residuals or ()) == 1 and scores[1]
    assert scores_of({"a": _unseen(1.5, 1.0), "b": _unseen(1.2, 1.0, (7, 9), "b")}) is None


def test_a_value_whose_method_fails_is_a_row_and_the_others_are_made(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, calls = vars(run_trial)["run_on"], iter(range(9))

    def failing(*args: Any) -> Any:
        if next(calls) == 1:
            raise ValueError("no matter")
        return original(*args)

    monkeypatch.setattr(run_trial, "run_on", failing)
    result = beamline("sweep", "scan.h5", "filter=hann,ram-lak,shepp-logan", "--json")
    assert result.exit_code == 0, result.output
    assert [(row["status"], row["message"]) for row in _table()] == [
        ("done", ""),
        ("failed", "no matter"),
        ("done", ""),
    ]
    assert len(json.loads(result.stdout.splitlines()[-1])["scores"]) == 2


LEGAL = ("tv-weight", "rings", "axis")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tv_weight=0.5:2:0.5", ("tv-weight", ("0.5", "1.0", "1.5", "2.0"))),
        ("--axis=84:85:0.3", ("axis", ("84.0", "84.3", "84.6", "84.9"))),
        ("axis=3:1:-1", ("axis", ("3", "2", "1"))),
        ("tv-weight=1e-3,2e-3", ("tv-weight", ("1e-3", "2e-3"))),
        ("rings=none, vo,none", ("rings", ("none", "vo"))),
    ],
)
def test_ranges_and_lists(text: str, expected: tuple[str, tuple[str, ...]]) -> None:
    option = swept_option(text, LEGAL)
    assert (option.name, option.values) == expected


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("tv_weigt=1,2", "did you mean tv-weight?"),
        ("rings", "expected NAME=A:B:STEP"),
        ("rings=vo", "at least two"),
        ("axis=5:1:1", "does not lead from"),
        ("axis=1:5:0", "does not lead from"),
        ("axis=1:5000:1", "use a larger STEP"),
    ],
)
def test_nonsense_is_refused(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why.replace("?", r"\?")):
        swept_option(text, LEGAL)


def test_options_of_a_slice_can_be_swept_and_those_of_a_volume_or_a_call_cannot() -> None:
    names = sweepable().keys()
    assert {"tv-weight", "rings", "axis", "phase", "bin", "views", "method", "filter", "iterations"} <= names
    assert not {"output", "config", "follow", "memory", "json", "roi", "dry-run"} & names
