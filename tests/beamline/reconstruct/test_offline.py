"""Offline reconstruction: the right volume with a complete record; if it fails, no file is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError
from beamline.core.events import Event
from beamline.monitor.digest import digest
from beamline.projections.selection import Selection
from beamline.reconstruct import checkpoints
from beamline.reconstruct.checkpoints import CheckpointOptions
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.storage.readers.open import SourceOptions
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from beamline.storage.writers.recon_file import read_checkpoint, read_reconstruction
from drivers.base.clock import SystemClock
from recon.assess.metrics import psnr
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.methods import build, by_name
from recon.splatting.r2 import R2
from recon.splatting.settings import FitSettings
from recon.voxels.direct import Fbp
from tests.beamline.scans import TwoCylinders, frames_of, write_exchange
from tests.clock import SteppedClock
from tests.slow_cases import others_slow

pytestmark = pytest.mark.usefixtures("one_thread")

SCAN = TwoCylinders(shape=(2, 40), pixel_size_mm=0.5)
R2_FIT = R2(steps=80, gaussians=300)
FIT = {"method": R2_FIT, "selection": Selection(axis_col=SCAN.axis_col)}


def _options(tmp_path: Path, **changes: object) -> ReconOptions:
    if not (tmp_path / "scan.h5").exists():
        write_exchange(tmp_path / "scan.h5", SCAN)
    options = ReconOptions(
        source=SourceOptions(tmp_path / "scan.h5"),
        target=OutputPaths(tmp_path / "out.h5", None),
        selection=Selection(),
        method=Fbp(),
        command="beamline recon scan.h5 -m fbp",
    )
    return replace(options, **changes)  # type: ignore[arg-type]


def _made(options: ReconOptions) -> ReconRecord:
    reconstruct_file(options, lambda event: None, SystemClock())
    return read_reconstruction(options.target.output)


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_the_times_of_all_phases_are_told_and_add_up_to_the_time_that_it_took(tmp_path: Path) -> None:
    events: list[Event] = []
    options = _options(tmp_path, method=build(by_name("sirt"), {"iterations": 2}))
    options = replace(options, target=replace(options.target, report=tmp_path / "out.html"))
    reconstruct_file(options, events.append, SteppedClock(tick=0.1))
    done = events[-1].data
    assert sum(done["times"].values()) == pytest.approx(done["elapsed"], abs=0.35)  # three looks beside the phases
    assert list(done["times"]) == [
        "opening the scan", "flags and references", "tilt and references", "rotation axis", "jumps", "correction",
        "phase filter",
        "background, rings, held-out projections, hardening", "compiling kernels", "reconstruction",
        "checking the volume", "FBP for comparison", "writing the volume", "report",
    ]  # fmt: skip
    begun = [event.data["phase"] for event in events if event.data.get("stage") == "phase" and event.data["n"] == 0]
    assert begun == list(done["times"])
    recorded = read_reconstruction(tmp_path / "out.h5").parameters
    assert recorded["seconds_of_correction"] == pytest.approx(done["times"]["correction"])


def test_fbp_is_the_object_in_inverse_millimetres(tmp_path: Path) -> None:
    events: list[Event] = []
    metrics = reconstruct_file(_options(tmp_path), events.append, SystemClock()).metrics
    record = read_reconstruction(tmp_path / "out.h5")
    truth = SCAN.truth(record.volume.grid)
    inside = truth == truth.max()
    assert record.volume.grid.voxel_size == pytest.approx(0.5)
    assert record.volume.data[inside].mean() == pytest.approx(truth.max(), rel=0.1)  # 0.14 / mm
    assert psnr(truth, record.volume.data) > 22
    assert metrics["residual"] < 0.1
    assert record.metrics == pytest.approx(metrics)
    done = events[-1]
    assert done.event == "done"
    assert done.data["output"] == tmp_path / "out.h5"
    assert done.data["axis_col"] == pytest.approx(SCAN.axis_col, abs=0.25)
    assert done.data["seconds"] == metrics["seconds"]
    assert [e.event for e in events if e.event != "progress"] == ["recon_started", "done"]


@pytest.mark.slow
@pytest.mark.usefixtures("real_pictures")
def test_r2_grows_from_the_same_views_and_is_compared_with_fbp(tmp_path: Path) -> None:
    events: list[Event] = []
    np.savez(
        tmp_path / "truth.npz", volume=SCAN.truth(Grid.matching(Geometry.parallel([0.0], (2, 40), pixel_pitch=0.5)))
    )
    target = OutputPaths(tmp_path / "out.h5", tmp_path / "out.html")
    options = _options(tmp_path, method=R2(steps=150, gaussians=400), target=target, truth=str(tmp_path / "truth.npz"))
    options = replace(options, selection=Selection(views="fixed:12", axis_col=SCAN.axis_col))
    metrics = reconstruct_file(options, events.append, SystemClock()).metrics
    assert metrics["psnr"] > events[-1].data["fbp"]["psnr"]  # 12 views: FBP has streaks
    assert metrics["residual_held_out"] < events[-1].data["fbp"]["residual_held_out"]
    assert {"ssim3d", "nrmse", "residual", "seconds"} <= set(metrics)
    # The sweeps of the finish tell of themselves, in their own unit, and are no steps of the fit.
    told = [event.data for event in events if event.data.get("stage") == "recon"]
    progress = [data for data in told if not data.get("unit")]
    assert progress[-1]["step"] == 150
    record = read_reconstruction(tmp_path / "out.h5")
    assert record.history["step"][-1] == 150
    assert len(record.history["loss"]) == len(progress)
    page = (tmp_path / "out.html").read_text(encoding="utf-8")
    for said in ("R²-Gaussian", "FBP", "beamline recon scan.h5", "12 of 45 projections"):
        assert said in page
    # Slices, profile, differences, quality, projection, sinogram, darks and flats; the axis was given.
    assert page.count("data:image/png;base64,") == 7


def test_every_setting_is_in_the_file(tmp_path: Path) -> None:
    selection = Selection(views="first:20", rows=(0, 2), binning=2, axis_col=20.7, seed=3)
    record = _made(_options(tmp_path, selection=selection, seed=3))
    said = {
        "method": "fbp",
        "axis_col": 20.7,
        "axis_source": "given, or stated in the file",
        "views": "first:20",
        "n_views": 20,
        "n_projections": 45,
        "rows": "0:2",
        "binning": 2,
        "pixel_pitch": 1.0,
        "pixel_pitch_unit": "mm",
        "quantity": "counts",
        "correction_floor": 1e-4,
        "noise": "logarithms of counts",
        "correction_air": "auto",
        "filter": "hann",
        "seed": 3,
        "command": "beamline recon scan.h5 -m fbp",
    }
    assert {name: record.parameters[name] for name in said} == said
    np.testing.assert_array_equal(record.parameters["view_frames"], np.arange(4, 24))
    np.testing.assert_allclose(np.asarray(record.parameters["view_angles_deg"]), np.degrees(SCAN.angles[:20]))
    assert Path(record.raw_file) == (tmp_path / "scan.h5").resolve()


def test_scale_unknown_means_pixels_and_a_given_one_wins(tmp_path: Path) -> None:
    with h5py.File(write_exchange(tmp_path / "scan.h5", SCAN), "r+") as file:
        del file.attrs["pixel_size_mm"]
    record = _made(_options(tmp_path))
    assert (record.length_unit, record.volume.grid.voxel_size) == ("px", 1.0)
    assert record.volume.data[:, 20:24, 23:27].max() == pytest.approx(0.07, rel=0.25)  # 1 / px
    given = _made(
        _options(tmp_path, selection=Selection(pixel_size_mm=0.25), target=OutputPaths(tmp_path / "b.h5", None))
    )
    assert (given.length_unit, given.volume.grid.voxel_size) == ("mm", 0.25)


@pytest.mark.parametrize("existing", ["out.h5", "out.html"])
def test_existing_results_are_never_touched(tmp_path: Path, existing: str) -> None:
    (tmp_path / existing).write_text("precious")
    with pytest.raises(DataError, match="never overwritten"):
        _made(_options(tmp_path, target=OutputPaths(tmp_path / "out.h5", tmp_path / "out.html")))
    assert (tmp_path / existing).read_text() == "precious"
    assert _names(tmp_path) == {"scan.h5", existing}


@pytest.mark.parametrize("error", others_slow([DataError("no space left"), ValueError("module://absent")]))
def test_a_report_that_fails_costs_a_warning_and_no_volume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("beamline.report.html.write_report", fail)
    events: list[Event] = []
    target = OutputPaths(tmp_path / "out.h5", tmp_path / "out.html")
    record = reconstruct_file(_options(tmp_path, target=target), events.append, SystemClock())
    assert _names(tmp_path) == {"scan.h5", "out.h5"} and record.report is None
    assert any(e.event == "warning" and str(error) in e.data["message"] for e in events)
    assert read_reconstruction(tmp_path / "out.h5").volume.data.any()


def test_a_scan_still_being_written_is_not_taken_for_a_finished_one(tmp_path: Path) -> None:
    writer = NXtomoWriter(tmp_path / "scan.h5", ScanInfo(sample="s"), (4, 8), clock=SystemClock())
    with pytest.raises(DataError):
        _made(_options(tmp_path))
    writer.close()
    assert _names(tmp_path) == {"scan.h5"}


def test_what_a_dead_scan_left_is_reconstructed_when_asked_for(tmp_path: Path) -> None:
    """The writer never closes its file, as when its process was killed."""
    events: list[Event] = []
    writer = NXtomoWriter(tmp_path / "scan.h5", ScanInfo(sample="s"), SCAN.shape, clock=SystemClock())
    for frame in frames_of(SCAN)[:-5]:
        writer.append(frame, digest(frame.counts))
    reconstruct_file(_options(tmp_path, unfinished=True), events.append, SystemClock())
    writer.close("failed")
    assert read_reconstruction(tmp_path / "out.h5").parameters["n_views"] == SCAN.angles.size - 5
    assert any(e.event == "warning" and "was not closed: 44 frames" in e.data["message"] for e in events)


@pytest.mark.slow
def test_a_fit_taken_up_again_is_the_one_without_a_break(tmp_path: Path) -> None:
    """Ended after some steps, begun again from its file: the same volume to the bit, with views held out as well."""
    selection = Selection(views="fixed:20", axis_col=SCAN.axis_col)
    whole = _options(tmp_path, **{**FIT, "selection": selection})
    uninterrupted = _made(whole).volume.data
    asked: list[int] = []

    @contextmanager
    def after_30_steps() -> Iterator[Callable[[], bool]]:
        yield lambda: len(asked) >= 30 or asked.append(0) is not None

    kept = tmp_path / "fit.checkpoint.h5"
    part = replace(whole, target=OutputPaths(tmp_path / "part.h5", None), checkpoints=CheckpointOptions(kept))
    reconstruct_file(part, lambda e: None, SystemClock(), after_30_steps)
    begun = read_reconstruction(tmp_path / "part.h5")
    assert begun.parameters["ended_early"] and np.abs(begun.volume.data - uninterrupted).max() > 0
    assert read_checkpoint(kept).state["counts"][1] == len(asked) + 1 < 80
    target = OutputPaths(tmp_path / "rest.h5", tmp_path / "rest.html")
    rest = _made(replace(whole, target=target, checkpoints=CheckpointOptions(None, kept)))
    np.testing.assert_array_equal(rest.volume.data, uninterrupted)
    assert rest.parameters["resumed_from"] == str(kept) and rest.parameters["steps"] == 80
    page = (tmp_path / "rest.html").read_text(encoding="utf-8")
    assert "since the fit was resumed" in page and " more would " not in page


@pytest.mark.slow
def test_the_state_is_kept_every_minute_of_the_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that is a second on at each look."""
    looks = count()
    clock = SystemClock()
    monkeypatch.setattr(clock, "now", lambda: float(next(looks)))
    steps: list[int] = []
    monkeypatch.setattr(checkpoints, "write_checkpoint", lambda _, kept: steps.append(int(kept.state["counts"][1])))
    reconstruct_file(
        _options(tmp_path, **FIT, checkpoints=CheckpointOptions(tmp_path / "fit.h5")), lambda e: None, clock
    )
    assert len(steps) > 2 and steps == sorted(steps) and steps[-1] == 80


@pytest.mark.slow
def test_a_checkpoint_of_another_fit_is_refused(tmp_path: Path) -> None:
    kept, fit = tmp_path / "fit.checkpoint.h5", R2(steps=5, gaussians=100)
    first = _options(tmp_path, **{**FIT, "method": fit}, checkpoints=CheckpointOptions(kept))
    _made(first)
    other = replace(first, checkpoints=CheckpointOptions(None, kept), target=OutputPaths(tmp_path / "b.h5", None))
    with pytest.raises(DataError, match=r"\(l2, l1"):
        _made(replace(other, method=replace(fit, fit=FitSettings(loss="l2")), seed=4))
    with pytest.raises(DataError, match="axis_col"):
        _made(replace(other, selection=Selection(axis_col=20.0)))
    assert _names(tmp_path) == {"scan.h5", "out.h5", "fit.checkpoint.h5"}


@pytest.mark.slow
def test_a_fit_that_stops_early_holds_views_out_and_says_so(tmp_path: Path) -> None:
    events: list[Event] = []
    options = _options(tmp_path, **{**FIT, "method": replace(R2_FIT, early_stop=True)})
    metrics = reconstruct_file(options, events.append, SystemClock()).metrics
    said = [event.data["message"] for event in events if event.event == "state"]
    assert said == ["4 of 45 projections are held out to decide when to stop"]
    assert "residual_held_out" in metrics
    record = read_reconstruction(tmp_path / "out.h5")
    assert record.parameters["n_views"] == 41
    assert np.isfinite(record.history["held_out"][-1])


@pytest.mark.parametrize("method", others_slow(["cgls", "os-sirt-tv"]))
def test_iterations_become_volume_history_and_report(tmp_path: Path, method: str) -> None:
    events: list[Event] = []
    options = _options(
        tmp_path, method=build(by_name(method), {"iterations": 8}), selection=Selection(axis_col=SCAN.axis_col),
        target=OutputPaths(tmp_path / "out.h5", tmp_path / "out.html"),
    )  # fmt: skip
    metrics = reconstruct_file(options, events.append, SystemClock()).metrics
    assert metrics["residual"] < 0.2
    progress = [event.data for event in events if event.data.get("stage") == "recon" and not event.data["unit"]]
    assert [p["step"] for p in progress] == list(range(1, 9))
    assert progress[-1]["per_s"] > 0 and progress[-1]["eta_s"] == 0
    record = read_reconstruction(tmp_path / "out.h5")
    assert (record.parameters["method"], record.parameters["iterations"]) == (method, 8)
    np.testing.assert_array_equal(record.history["step"], np.arange(1, 9))
    assert by_name(method).label in (tmp_path / "out.html").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.long
def test_walnut_from_60_views_is_better_than_fbp(tmp_path: Path, shared_data: Path) -> None:
    """Measured data (Meaney 2022), 8 rows: R² from 60 of 240 views beats FBP of these views by more than 1 dB."""
    events: list[Event] = []
    options = _options(
        tmp_path,
        source=SourceOptions(shared_data / "walnut_parallel_rebinned_240x96x256.h5", quantity="line_integrals"),
        method=R2(steps=400),
        selection=Selection(views="fixed:60", rows=(44, 52)),
        truth=f"{shared_data / 'walnut_fdk_256.npz'}:114:122",
        target=OutputPaths(tmp_path / "out.h5", tmp_path / "out.html"),
    )
    metrics = reconstruct_file(options, events.append, SystemClock()).metrics
    assert metrics["psnr"] > events[-1].data["fbp"]["psnr"] + 1.0
    assert events[-1].data["axis_col"] == pytest.approx(127.5, abs=0.5)
