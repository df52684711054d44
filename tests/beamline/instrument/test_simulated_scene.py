"""Values of a simulated scene reach the run: labels next to the file, a cone geometry in it, or an error."""

from pathlib import Path

import numpy as np
import pytest

from beamline.config.models import Config
from beamline.core.errors import ConfigError, DataError, ScanStopped
from beamline.core.events import BlockStarted, Event
from beamline.core.sinks import Announcer
from beamline.core.stop import StopRequest
from beamline.projections.corrections.air import Air
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.views import select
from beamline.scan.dry_run import dry_run
from beamline.scan.run import run_scan
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter
from drivers.base.frame import Frame, FrameKind
from recon.base.volume import Grid
from recon.voxels.direct import fdk
from tests.beamline.ball_scan import BALL, shipped, with_scene
from tests.beamline.simulate.read_labels import read_labels

ROI = [1136, 2028, 32, 40]
GHOST = {"kind": "ghost", "view": 4, "width": 0.05, "speed": 0.02}
BAND = {"kind": "black_band", "width": 0.01, "penumbra": 0.001}


def _config(scene: dict[str, object], *overrides: str) -> Config:
    few = (
        "scan.mode=step",
        "scan.angles={scheme: fixed, views: 12, span_deg: 360}",
        "scan.darks.count=2",
        "scan.flats.count=1",
    )
    loaded = shipped("simulated", f"devices.camera.roi={ROI}", "simulation.clock=virtual", *few, *overrides)
    return with_scene(loaded, scene)


def _labels(folder: Path) -> dict[str, tuple[int, int]]:
    return {run.kind: (run.first, run.last) for run in read_labels(folder / "scan.labels.json")}


def test_labels_of_injected_anomalies_lie_beside_the_file(tmp_path: Path) -> None:
    result = run_scan(_config(BALL | {"effects": [GHOST, BAND]}), tmp_path)
    with open_scan(result.path) as source:
        kinds, frames = source.table.kinds, source.read(slice(None)).astype(float)
    light = np.flatnonzero(kinds != FrameKind.DARK)
    runs = read_labels(result.path.with_name("scan.labels.json"))
    bands = [run for run in runs if run.kind == "black_band"]
    # Two darks, a flat, 12 views and a flat: the band is in all but the darks, and there it is dark.
    assert [(run.first, run.last) for run in bands] == [(2, 15)]
    top, below, left, right = bands[0].regions[0]
    assert (frames[light, top:below, left : right - 1].mean(axis=(1, 2)) < 0.6 * frames[light].max(axis=(1, 2))).all()
    (ghost,) = (run for run in runs if run.kind == "ghost")
    row = ghost.first - 3  # of the views
    assert 0 <= row <= 4 <= ghost.last - 3 <= 11


def test_no_anomaly_is_said_too_and_a_stopped_scan_has_labels_of_its_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert _labels(run_scan(_config(BALL), tmp_path / "none").path.parent) == {}
    stop, announce = StopRequest(), Announcer.__call__

    def stop_at_the_views(self: Announcer, event: Event) -> None:
        # In the scan's own thread: a sink runs in another, and a scan on a virtual clock may be over before it stops.
        if isinstance(event, BlockStarted) and event.kind == "projection":
            stop.stop("enough")
        announce(self, event)

    monkeypatch.setattr(Announcer, "__call__", stop_at_the_views)
    with pytest.raises(ScanStopped):
        run_scan(_config(BALL | {"effects": [BAND]}), tmp_path / "some", stop=stop)
    (folder,) = (tmp_path / "some").iterdir()
    with open_scan(folder / "scan.h5") as source:
        last = int(np.flatnonzero(source.table.kinds != FrameKind.DARK).max())
        assert last < 15
    assert _labels(folder) == {"black_band": (2, last)}


def test_labels_end_with_the_frames_that_are_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    append = NXtomoWriter.append

    def full(self: NXtomoWriter, frame: Frame, *rest: object) -> None:
        if frame.index == 6:
            raise DataError("the disk is full")
        append(self, frame, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(NXtomoWriter, "append", full)
    with pytest.raises(DataError, match="the disk is full"):
        run_scan(_config(BALL | {"effects": [BAND]}), tmp_path)
    (folder,) = tmp_path.iterdir()
    assert _labels(folder) == {"black_band": (2, 5)}


SOD, SDD = 1.0, 3.0
CONE = BALL | {"beam": {"photons_per_s": 1.0e5, "sod": SOD, "sdd": SDD}, "axis_offset_px": 1.5}


@pytest.mark.slow
def test_the_file_of_a_cone_gives_back_the_sample_where_it_stands(tmp_path: Path) -> None:
    wanted = ("optics.axis_col=21", "scan.angles={scheme: fixed, views: 60, span_deg: 360}")
    result = run_scan(_config(CONE, *wanted), tmp_path)
    said: list[str] = []
    with open_scan(result.path) as source:
        assert (source.cone, source.attributes["distance_mm"]) == ((SOD, SDD), SDD - SOD)
        assert source.pixel_size_mm == pytest.approx(4.6e-3 * SDD / SOD)  # NXtomo's is that on the detector
        prepared = prepare_projections(select(source, Selection(steps=(Air("none"),))), said.append)
    geometry = prepared.geometry
    assert (geometry.is_cone, geometry.axis_col, geometry.axis_row) == (True, 21.0, 15.5)
    grid = Grid.matching(geometry)
    assert grid.voxel_size == pytest.approx(4.6e-3)
    volume = fdk(prepared.seen.data, geometry, grid, "hann")
    weights = np.clip(volume, 10.0, None) - 10.0  # streaks are far below a third of 30/mm
    z, y, x = grid.coordinates()
    for axis, expected in ((x, 0.06), (y[:, None], 0.0), (z[:, None, None], 0.01)):
        assert (weights * axis).sum() / weights.sum() == pytest.approx(expected, abs=0.1 * grid.voxel_size)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ((), r"set optics.axis_col, here to 21: .*Nothing was started"),
        (("devices.camera.binning=2",), r"set optics.axis_col, here to 10\.25: .*Nothing"),
        (("devices.camera.roi=[1100, 2028, 32, 40]",), r"begin the 32 rows at row 1136, not at 1100"),
    ],
)
def test_a_cone_that_its_file_could_not_tell_is_refused(tmp_path: Path, overrides: tuple[str, ...], words: str) -> None:
    settings = _config(CONE, *overrides)
    with pytest.raises(ConfigError, match=words):
        dry_run(settings)
    with pytest.raises(ConfigError, match=words):
        run_scan(settings, tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
