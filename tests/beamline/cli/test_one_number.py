"""One name, one number: a figure is the same wherever it is shown."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import recon
from beamline.core.events import StateEntered, Warned
from beamline.core.sinks import Note, Warnings
from beamline.projections.prepare import prepare_projections, report_defects
from beamline.projections.selection import Selection
from beamline.reconstruct.measure import measure
from beamline.report.metrics import METRICS
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from recon.voxels.direct import direct
from recon.voxels.projector import Projector
from recon.voxels.resolution import ViewResolution
from tests.beamline.array_source import ArraySource
from tests.beamline.cli.small_scan import SCAN, beamline, succeeds
from tests.beamline.prepared_views import prepared_views
from tests.beamline.scans import write_exchange
from tests.clock import SteppedClock

SWEEP = "beamline.features.sweeps.sweep"
pytestmark = pytest.mark.usefixtures("one_thread")


def test_the_residual_of_views_held_out_of_recon_sweep_and_tradeoff(folder: Path) -> None:
    """The same volume and the same views: one figure, and one label."""
    sweep, worker = pytest.importorskip(SWEEP), pytest.importorskip("beamline.features.trials.worker")
    source = ArraySource(SCAN.line_integrals().astype(np.float32), [0] * len(SCAN.angles), SCAN.angles)
    source.quantity = "line_integrals"
    prepared = prepare_projections(source, Selection(views="every:3", axis_col=20.7), lambda _: None)  # type: ignore[arg-type]
    prepared = replace(prepared, view_weights=None)
    grid = Grid.matching(prepared.geometry)
    volume = Volume(direct(prepared.projections.data, prepared.geometry, grid, "hann"), grid)
    by_recon = measure(volume, prepared, None)["residual_held_out"]
    assert prepared.held_out is not None and prepared.held_out_ids is not None
    projector = Projector(prepared.held_out[1], grid)
    one = sweep.SweptSlice(
        {"a": "1"}, volume.data[0], 0.0, prepared, projector.forward(volume.data), projector.resolution
    )
    scores = sweep.scores_of([one])
    assert scores is not None
    by_tradeoff, _ = worker.measured("fbp", volume.data, worker.TrialData(prepared, None), grid)
    assert scores.shares[0] == pytest.approx(by_recon, rel=1e-5)
    assert by_tradeoff["residual_held_out"] == pytest.approx(by_recon, rel=1e-5)
    swept = beamline("sweep", "scan.h5", "filter=ram-lak,hann", "--axis", "20.7")
    assert METRICS["residual_held_out"].label in swept.stdout


def test_times_of_the_terminal_the_page_and_the_events(folder: Path) -> None:
    shown = succeeds("recon", "scan.h5", "-m", "cgls", "--axis", "20.7", "-o", "shown.h5")
    page = re.sub(r"<[^>]*>|\s+", " ", (folder / "shown.html").read_text(encoding="utf-8"))
    for label in ("Time of reconstruction", "Time of the whole command"):
        on_page, on_terminal = (
            sorted(re.findall(r"([\d.]+) s\b", text.partition(label)[2][:80].partition("Time of")[0]))
            for text in (page, shown.output)
        )
        assert on_page == on_terminal != []
    told = beamline("recon", "scan.h5", "-m", "cgls", "--axis", "20.7", "-o", "told.h5", "--json")
    done = json.loads(told.stdout.splitlines()[-1])
    page = re.sub(r"<[^>]*>|\s+", " ", (folder / "told.html").read_text(encoding="utf-8"))
    assert f"{done['elapsed']:.1f} s" in page.partition("Time of the whole command")[2][:80]


@pytest.mark.slow
def test_times_of_a_followed_scan_on_the_terminal_and_the_page_and_in_events(folder: Path) -> None:
    scene = {
        "phantom": {
            "kind": "solids",
            "solids": [{"kind": "ellipsoid", "semi_axes": [0.1, 0.1, 0.1], "attenuation": 3}],
        },
        "beam": {"photons_per_s": 1e5},
        "detector": {"shape": [12, 32], "pixel_size_um": 12.0, "exposure_s": 0.02},
        "scan": {"views": 24, "darks": 2, "flats": 2},
    }
    (folder / "scene.yaml").write_text(json.dumps(scene), encoding="utf-8")
    succeeds("simulate", "scene.yaml", "--out", "own.h5")
    followed = "recon", "own.h5", "--follow", "--seconds", "1", "--gaussians", "200", "--axis", "15.5"
    shown, told = beamline(*followed, "-o", "shown.h5"), beamline(*followed, "-o", "told.h5", "--json")
    assert shown.exit_code == told.exit_code == 0, shown.output + told.output
    done = json.loads(told.stdout.splitlines()[-1])
    for label, of_event in (("reconstruction", done["seconds"]), ("the whole command", done["elapsed"])):
        pages = [(folder / name).read_text(encoding="utf-8") for name in ("shown.html", "told.html")]
        on_shown, on_told, on_terminal = (
            sorted(re.findall(r"([\d.]+) s\b", text.partition(f"Time of {label}")[2][:80].partition("Time of")[0]))
            for text in (*(re.sub(r"<[^>]*>|\s+", " ", page) for page in pages), shown.output)
        )
        assert on_shown == on_terminal != [] and f"{of_event:.1f}" in on_told
    assert 0 < done["seconds"] <= done["elapsed"]


@pytest.mark.feature
@pytest.mark.slow
def test_a_study_names_what_its_figures_are_of(folder: Path) -> None:
    """Rows are compared with the volume of all views by their own method; contrast with rims has another name."""
    write_exchange(folder / "many.h5", replace(SCAN, angles=np.radians(np.arange(0, 180, 2.0))))
    result = succeeds("study", "fixed-views", "many.h5", "--axis", "20.7", "-m", "fbp", "-m", "cgls", "-o", "study")
    with (folder / "study" / "study.csv").open(encoding="utf-8", newline="") as file:
        assert {"psnr_all", "ssim_all"} <= set(next(csv.DictReader(file)))
    assert "by the same method" in result.stdout


def test_python_says_it_in_a_line_and_warns() -> None:
    views = SCAN.line_integrals().astype(np.float32)
    found = recon.find_axis(views, SCAN.angles)
    assert str(found).startswith(f"column {found.value:.2f} by ") and "\n" not in str(found)
    geometry = Geometry.parallel(SCAN.angles, views.shape[1:], axis_col=20.7)
    views[0, 0, 0] = np.nan
    with pytest.warns(UserWarning, match="1 of .* values of the projections are not finite"):
        recon.reconstruct(views, geometry, "fbp")
    assert Geometry.cone.__doc__ is not None and "in the plane of the detector" in Geometry.cone.__doc__


def test_what_was_done_is_a_note_and_what_may_be_wrong_a_warning() -> None:
    events: list[object] = []
    warn = Warnings(events.append, SteppedClock(0.0))
    warn("something may be wrong")
    warn(Note("something was done"))
    assert [type(event) for event in events] == [Warned, StateEntered]
    projections = recon.correct(
        np.full((4, 8, 8), 90.0), np.arange(4.0), recon.References(np.zeros((8, 8)), ((0.0, np.full((8, 8), 100.0)),))
    )
    told: list[str] = []
    masked = np.zeros((8, 8), bool)
    masked[3, 3] = True
    report_defects(replace(projections, masked=masked, floored=0.5), told.append)
    assert [isinstance(sentence, Note) for sentence in told] == [True, False]


def test_a_sweep_whose_residual_hardly_changes_names_no_value() -> None:
    sweep = pytest.importorskip(SWEEP)
    image, views_at = np.zeros((8, 8), np.float32), Geometry.parallel(np.arange(4.0), (2, 8))
    lines = np.ones((4, 2, 8), np.float32)
    views = prepared_views(lines, views_at, held_out=(lines, views_at), held_out_ids=np.arange(4))
    even = ViewResolution.of(views_at, Grid.matching(views_at))

    def leaving(share: float) -> object:
        return sweep.SweptSlice(
            {"axis": str(share)}, image, 0.0, views, np.full((4, 2, 8), 1 + share, np.float32), even
        )

    flat, clear = (sweep.scores_of([leaving(0.1), leaving(worse)], direct=True) for worse in (0.103, 0.12))
    assert flat is not None and flat.best is None and not any(flat.verdicts)
    assert clear is not None and clear.best == 0
