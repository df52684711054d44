"""The same quantity has the same value wherever it is shown."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.report.metrics import METRICS
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from recon.judgement import judge
from recon.voxels.direct import direct
from recon.voxels.projector import Projector, projection_lines
from recon.voxels.resolution import ViewResolution
from tests.beamline.array_source import ArraySource
from tests.beamline.cli.small_scan import SCAN, beamline, succeeds

SWEEP = "beamline.features.trials.sweep"
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.slow
def test_the_residual_of_views_held_out_of_recon_sweep_and_tradeoff(folder: Path) -> None:
    """The same volume and the same views: one figure, and one label."""
    sweep, trials = pytest.importorskip(SWEEP), pytest.importorskip("beamline.features.trials.run_trial")
    trial = pytest.importorskip("beamline.features.trials.trial").MethodTrial("method", "fbp", 10)
    source = ArraySource(SCAN.line_integrals().astype(np.float32), [0] * len(SCAN.angles), SCAN.angles)
    source.quantity = "line_integrals"
    prepared = prepare_projections(select(source, Selection(views="every:3", axis_col=20.7)), lambda _: None)
    prepared = replace(prepared, sources=replace(prepared.sources, view_weights=None))
    grid = Grid.matching(prepared.geometry)
    volume = Volume(direct(prepared.seen.data, prepared.geometry, grid, "hann"), grid)
    by_recon = judge(volume, prepared.views).figures["residual_held_out"]
    apart = prepared.lines.unseen
    assert apart is not None
    projector, ids = Projector(apart.geometry, grid), apart.ids
    model, data = (projection_lines(each) for each in (projector.forward(volume.data), apart.data))
    scores = sweep.scores_of({"a 1": sweep.UnseenViews(ids, data, model, projector.resolution, "")})
    assert scores is not None
    by_tradeoff, _ = trials.TrialData(prepared.views).measured(trial, volume)
    assert sweep.shares_of(scores[0])[0] == pytest.approx(by_recon, rel=1e-5)
    assert by_tradeoff["residual_held_out"] == pytest.approx(by_recon, rel=1e-5)
    swept = beamline("sweep", "scan.h5", "filter=ram-lak,hann", "--axis", "20.7")
    assert METRICS["residual_held_out"].label in swept.stdout


@pytest.mark.slow
def test_times_of_the_terminal_the_page_and_the_events(folder: Path) -> None:
    shown = succeeds("recon", "scan.h5", "-m", "cgls", "--axis", "20.7", "-o", "shown.h5")
    page = re.sub(r"<[^>]*>|\s+", " ", (folder / "shown.html").read_text(encoding="utf-8"))
    for label in ("Time of reconstruction", "Total time, without loading the program"):
        on_page, on_terminal = (
            sorted(re.findall(r"([\d.]+) s\b", text.partition(label)[2][:80].partition("Time of")[0]))
            for text in (page, shown.output)
        )
        assert on_page == on_terminal != []
    told = beamline("recon", "scan.h5", "-m", "cgls", "--axis", "20.7", "-o", "told.h5", "--json")
    done = json.loads(told.stdout.splitlines()[-1])
    page = re.sub(r"<[^>]*>|\s+", " ", (folder / "told.html").read_text(encoding="utf-8"))
    assert f"{done['elapsed']:.1f} s" in page.partition("Total time, without loading the program")[2][:80]


@pytest.mark.slow
def test_a_sweep_whose_residual_hardly_changes_names_no_value() -> None:
    sweep = pytest.importorskip(SWEEP)
    views_at = Geometry.parallel(np.arange(4.0), (2, 8))
    even = ViewResolution.of(views_at, Grid.matching(views_at))

    def leaving(share: float) -> object:
        data, model = (np.full((4, 8, 2), value, np.float32) for value in (1, 1 + share))
        return sweep.UnseenViews(np.arange(4), data, model, even, "")

    flat, clear = (
        sweep.scores_of({"axis 1": leaving(0.1), "axis 2": leaving(worse)}, direct=True) for worse in (0.103, 0.12)
    )
    assert flat is not None and flat[0].verdicts == ["", ""]
    assert clear is not None and clear[0].verdicts == ["best", ""]
