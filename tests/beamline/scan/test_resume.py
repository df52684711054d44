"""A run that ended early goes on: its missing views, and no others, join those that it has, whose files stay as they
are."""

import hashlib
import re
import shutil
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import h5py
import numpy as np
import pytest

from beamline.core.errors import BeamlineError, ConfigError, DataError
from beamline.core.files import parts_of
from beamline.core.run_result import RunResult
from beamline.core.stop import StopRequest
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import describe, validate
from beamline.page.run_files import Reader, watched
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.views import checked_views, evidence_of
from beamline.scan import control
from beamline.scan.control import State, Verb, running, tell
from beamline.scan.resume import ResumableRun, open_for_resume, recover_run
from beamline.scan.run import run_scan
from beamline.storage.hdf5 import open_hdf5
from beamline.storage.interrupted import whole_scan
from beamline.storage.readers.open import open_scan
from beamline.storage.readers.reference_files import overlaid
from beamline.storage.writer_lock import WriterLock
from beamline.storage.writers import layout
from drivers.base.frame import FrameKind
from tests.beamline.fakes import FakeInstrument, Faults, assert_true
from tests.beamline.ran import Ran, killed, small

FIRST = 5  # 3 darks and 2 flats
VIEWS = 12
MODES = {
    "fly": ("scan.mode=fly",),
    "step": ("scan.mode=step",),
    "interlaced": ("scan.mode=fly", "scan.angles={scheme: interlaced, views: 12, passes: 2}"),
    "backwards": ("scan.mode=fly", "scan.angles={scheme: fixed, views: 12, start_deg: 90, span_deg: -180}"),
}


def _stopped(runs: Path, monkeypatch: pytest.MonkeyPatch, *overrides: str, at: int, abort: bool) -> Path:
    stop = StopRequest()
    act = stop.abort if abort else stop.stop
    ran = Ran(runs, FakeInstrument(at={at: act}), *overrides, stop=stop)
    return ran.folder


def _killed(runs: Path, monkeypatch: pytest.MonkeyPatch, *overrides: str, at: int) -> Path:
    with killed(monkeypatch):
        return _stopped(runs, monkeypatch, *overrides, at=at, abort=True)


@pytest.fixture(scope="module")
def aborted_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        return _stopped(tmp_path_factory.mktemp("runs"), patch, at=FIRST + 4, abort=True)


@pytest.fixture
def run(aborted_once: Path, tmp_path: Path) -> Path:
    """A run with four views."""
    return shutil.copytree(aborted_once, tmp_path / "runs" / aborted_once.name)


def _lossy(runs: Path, monkeypatch: pytest.MonkeyPatch, *overrides: str, at: int) -> Path:
    """To its end, with three views lost, two of them side by side, one the last."""
    ran = Ran(runs, FakeInstrument(Faults(lost={FIRST + 2}, ignored={FIRST + 3, FIRST + VIEWS - 1})), *overrides)
    return ran.folder


ENDS: dict[str, Callable[..., Path]] = {
    "killed": _killed,
    "stopped": lambda *given, at: _stopped(*given, at=at, abort=False),
    "aborted": lambda *given, at: _stopped(*given, at=at, abort=True),
    "lossy": _lossy,
}


def _go_on(run: Path, instrument: FakeInstrument | None = None, **more: object) -> RunResult:
    instrument = instrument or FakeInstrument()
    instrument.clock.sleep(1000.0 * len(parts_of(run)))  # the clock of each begins at the same time
    with open_for_resume(run) as series:
        return run_scan(series.config, series, instrument=instrument.connected(), **more)  # type: ignore[arg-type]


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _assert_whole(path: Path, references: int) -> None:
    """Every view once, at its angle and with the pixels of its angle, and so many darks and flats."""
    with open_scan(path) as source:
        frames = list(source.frames())
    views = [frame for frame in frames if frame.kind is FrameKind.PROJECTION]
    assert sorted(frame.trigger for frame in views) == list(range(VIEWS))
    assert sum(frame.kind in (FrameKind.DARK, FrameKind.FLAT) for frame in frames) == references
    assert_true(frames)


@pytest.mark.parametrize(
    ("end", "mode"),
    [("killed", "step"), ("stopped", "interlaced"), ("aborted", "backwards"), ("lossy", "fly")],
)
def test_only_the_missing_views_are_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: str, mode: str) -> None:
    run = ENDS[end](tmp_path, monkeypatch, *MODES[mode], at=FIRST + 4)
    with open_for_resume(run) as series:
        assert 0 < len(series.views) < VIEWS
        missing = VIEWS - len(series.views)
    if end == "killed":
        recover_run(run)
    before = _digest(run / "scan.h5")
    result = _go_on(run)
    assert result.path == run / "joined.h5"
    assert (result.missing, _digest(run / "scan.h5")) == ((), before)
    with h5py.File(run / "part-2/scan.h5") as part, h5py.File(run / "scan.h5") as first:
        assert (part[layout.KIND][()] == FrameKind.PROJECTION).sum() == missing
        references = (first[layout.KIND][()] != FrameKind.PROJECTION).sum() + 7
    _assert_whole(run / "joined.h5", references)
    assert [finding.severity for finding in validate(run / "joined.h5", lambda done, of: None)] in ([], ["warning"])
    with h5py.File(run / "joined.h5") as file:  # as another program reads it
        assert len(file["exchange/data"]) == VIEWS
        np.testing.assert_array_equal(file["exchange/data"][-1], file["entry/data/data"][-3])
    with pytest.raises(ConfigError, match="nothing is missing"):
        _go_on(run)


def test_a_killed_run_is_recovered_by_the_way_and_can_be_resumed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = _killed(tmp_path, monkeypatch, at=FIRST + 3)
    stop = StopRequest()
    with pytest.raises(BeamlineError, match="Stopped after 8 of 12 projections"):
        _go_on(run, FakeInstrument(at={FIRST + 3: stop.stop}), stop=stop)
    with open_for_resume(run) as series:
        assert (len(series.parts), series.views) == (2, frozenset(range(8)))
    assert _go_on(run).path == run / "joined.h5"
    _assert_whole(run / "joined.h5", 5 + 5 + 7)
    (run / "joined.h5").unlink()
    assert [done.path.parent.name for done in recover_run(run)[0]] == [run.name, "part-2", "part-3", run.name]
    _assert_whole(run / "joined.h5", 5 + 5 + 7)


def test_a_view_that_became_invalid_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = _stopped(tmp_path, monkeypatch, at=FIRST + 8, abort=True)
    with h5py.File(run / "scan.h5", "r+", libver=layout.LIBVER) as file:
        file[layout.KIND][FIRST + 2] = file[layout.IMAGE_KEY][FIRST + 2] = FrameKind.INVALID
    with open_for_resume(run) as series:
        assert 2 not in series.views
    _go_on(run)
    with open_scan(run / "joined.h5") as source:
        assert sorted(f.trigger for f in source.frames() if f.kind is FrameKind.PROJECTION) == list(range(VIEWS))


def _assert_told_of_parts(run: Path) -> None:
    """Each part names the joined file, which speaks of no other, and is not reconstructed by itself."""
    for part in (run / "scan.h5", run / "part-2/scan.h5"):
        line = f"This file is one of 2 parts of a scan: give {run / 'joined.h5'}, which has the frames of all."
        assert sum(finding.startswith(line) for finding in describe(part)["findings"]) == 1
        with open_scan(part) as source, pytest.raises(DataError, match=re.escape(line)):
            accepting = Selection(steps=(Preparation(references="accept"),))
            checked_views(evidence_of(source, accepting), accepting.of(source), lambda _: None)
        assert whole_scan(part) == run / "joined.h5" == watched(part).scan
    with closing(Reader(watched(run))) as reader:
        assert reader.state()["frames"] == open_scan(run / "joined.h5").table.kinds.size
    facts = describe(run / "joined.h5")
    assert not any("parts of a scan" in finding for finding in facts["findings"])
    assert facts["kinds"]["projection"] == VIEWS
    assert facts["attributes"]["status"] == "complete"
    assert (facts["missing_triggers"], facts["attributes"]["parts"]) == (0, "scan.h5, part-2/scan.h5")


def test_the_views_of_all_parts_are_corrected_together(run: Path, tmp_path: Path) -> None:
    _go_on(run)
    _assert_told_of_parts(run)
    assert ingest(run / "joined.h5", tmp_path / "ingested.h5").doubts == ()
    assert "one of 2 parts" in ingest(run / "scan.h5", tmp_path / "part.h5").doubts[0]
    images = np.zeros((2, 8, 12), np.uint16)
    for path in (run / "joined.h5", tmp_path / "ingested.h5"):
        with open_scan(path) as source, h5py.File(run / "scan.h5") as part:
            frames = int(part[layout.COMMITTED][()])
            assert source.table.part_starts.tolist() == [0, frames]
            assert overlaid(source, darks=images).table.part_starts.tolist() == [0, frames + 2]
            assert overlaid(source, flats=images).table.part_starts.tolist() == [0]
    with open_scan(run / "joined.h5") as source:
        selection = Selection(axis_col=5.5, steps=(Air("none"), Preparation("ignore")))
        prepared = prepare_projections(source, selection, lambda said: None)
    assert len(prepared.projections.data) == VIEWS


def _without_a_flat(runs: Path, monkeypatch: pytest.MonkeyPatch, *overrides: str, at: int) -> Path:
    ran = Ran(runs, FakeInstrument(Faults(lost={at + 1})), *overrides)
    return ran.folder


@pytest.mark.parametrize(
    ("end", "taken", "overrides"),
    [
        (_without_a_flat, "FF", ()),
        (ENDS["aborted"], "FFDDD", ("scan.darks.at=both", "scan.mode=step")),
        (ENDS["aborted"], "FF", ("scan.flats.at=end",)),
    ],
)
def test_references_of_the_end_alone_are_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: Callable[..., Path], taken: str, overrides: tuple[str, ...]
) -> None:
    at = (3 if "scan.flats.at=end" in overrides else FIRST) + VIEWS  # the first flat after the views
    run = end(tmp_path, monkeypatch, *overrides, at=at)
    with open_hdf5(run / "scan.h5") as first:
        before = int((first[layout.KIND][()] != FrameKind.PROJECTION).sum())
    instrument = FakeInstrument()
    result = _go_on(run, instrument)
    assert (result.path, result.missing) == (run / "joined.h5", ())
    with h5py.File(run / "part-2/scan.h5") as part:
        assert "".join(FrameKind(kind).name[0] for kind in part[layout.KIND][()]) == taken
    assert not any(told == "arm stage" for told in instrument.log)
    _assert_whole(run / "joined.h5", before + len(taken))
    assert [finding for finding in validate(run / "joined.h5") if finding.severity == "error"] == []
    assert describe(run / "joined.h5")["missing_triggers"] == 0
    with open_scan(run / "joined.h5") as source:
        prepared = prepare_projections(
            source,
            Selection(axis_col=5.5, steps=(Air("none"), Preparation("ignore", "accept"))),
            lambda said: None,
        )
    assert len(prepared.projections.data) == VIEWS
    with pytest.raises(ConfigError, match="all views that it was to take"):
        _go_on(run)


def test_a_stop_before_references_of_the_end_leaves_the_run_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = _stopped(tmp_path, monkeypatch, at=FIRST + VIEWS, abort=True)
    stop = StopRequest()
    with open_for_resume(run) as series:
        assert series.in_words.endswith("has all 12 views, its missing flats of the end are taken now")
        with pytest.raises(BeamlineError, match="before the first frame"):
            run_scan(
                series.config, series, [lambda event: stop.stop() if event.event == "run_started" else None], stop,
                instrument=FakeInstrument().connected(),
            )  # fmt: skip
    assert not (run / "joined.h5").exists()
    assert _go_on(run).n_frames == FIRST + VIEWS + 1 + 2


def test_verbs_reach_the_newest_part(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "EFFECT_WITHIN", 0.2)
    told: list[tuple[list[Path], str]] = []

    with pytest.raises(BeamlineError, match="Aborted"):
        _go_on(run, FakeInstrument(at={FIRST: lambda: told.append((running(run.parent), tell(run, Verb.ABORT)))}))
    assert told == [([run], State.ACQUIRING)]


def _unreadable(run: Path) -> None:
    (run / "config.resolved.yaml").unlink()


def _other_exposure(run: Path) -> None:
    said = (run / "config.resolved.yaml").read_text()
    (run / "config.resolved.yaml").write_text(said.replace("exposure_s: 0.02", "exposure_s: 0.03"))


def _without_plan(run: Path) -> None:
    with h5py.File(run / "scan.h5", "r+", libver=layout.LIBVER) as file:
        file["/entry/record/plan"][()] = "{}"


def _other_camera(run: Path) -> None:
    with h5py.File(run / "scan.h5", "r+", libver=layout.LIBVER) as file:
        del file["/entry/instrument/devices/camera/model"]
        file["/entry/instrument/devices/camera/model"] = "another one"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_unreadable, "not the folder of a run"),
        (_other_exposure, "another configuration: `exposure_s: 0.02`, not `exposure_s: 0.03`"),
        (_without_plan, "has no plan"),
        (_other_camera, "another camera: model another one; now there is model fake camera"),
    ],
)
def test_what_cannot_go_on_is_refused_in_one_line(run: Path, change: Callable[[Path], None], said: str) -> None:
    change(run)
    before = {path: _digest(path) for path in run.rglob("*") if path.is_file()}
    with pytest.raises(BeamlineError, match=said) as refused:
        _go_on(run)
    assert "\n" not in str(refused.value)
    assert "Nothing was changed" in str(refused.value)
    assert {path: _digest(path) for path in run.rglob("*") if path.is_file()} == before


def test_a_run_that_another_process_holds_is_refused(run: Path) -> None:
    lock = WriterLock(run / "scan.h5")
    with pytest.raises(DataError, match="open in a program that still runs"):
        _go_on(run)
    lock.release()
    with open_for_resume(run), pytest.raises(ConfigError, match="another process goes on"):
        _go_on(run)
    with (
        pytest.raises(ConfigError, match="configuration: `views: 12`"),
        open_for_resume(run, small("scan.angles.views=24")),
    ):
        pass
    assert not (run / "part-2").exists()


def test_a_new_part_that_took_nothing_does_not_matter(run: Path) -> None:
    stop = StopRequest()

    def began(series: ResumableRun) -> None:
        run_scan(
            series.config, series, [lambda event: stop.abort() if event.event == "run_started" else None], stop,
            instrument=FakeInstrument().connected(),
        )  # fmt: skip

    with open_for_resume(run) as series, pytest.raises(BeamlineError):
        began(series)
    (run / "part-2" / "scan.h5").write_bytes(b"")  # as if it was killed while the file was made
    with (run / "part-2" / "events.jsonl").open("ab") as events:
        events.write(b"\xff")  # and a block of the disk was lost
    _, left_out = recover_run(run)
    assert len(left_out) == 1 and "part-2" in left_out[0]
    with open_for_resume(run) as series:
        assert list(series.left_out) == left_out
    _go_on(run)
    with open_scan(run / "joined.h5") as source:
        assert (source.table.kinds == FrameKind.PROJECTION).sum() == VIEWS


def test_a_part_counts_by_its_file_where_its_events_were_lost(run: Path) -> None:
    stop = StopRequest()
    with pytest.raises(BeamlineError):
        _go_on(run, FakeInstrument(at={FIRST + 3: stop.abort}), stop=stop)
    with open_for_resume(run) as series:
        views = series.views
    (run / "part-2" / "events.jsonl").write_bytes(b"")
    with open_for_resume(run) as series:
        assert (len(series.parts), series.views, series.left_out) == (2, views, ())
    assert [done.path.parent.name for done in recover_run(run)[0]] == [run.name, "part-2", run.name]


def test_the_volume_of_all_parts_is_that_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = _stopped(tmp_path, monkeypatch, at=8, abort=False)
    (run / "recon.h5").write_text("of some views")
    (run / "report.html").write_text("of some views")
    asked: list[tuple[Path, Path]] = []

    def live(scan: Path, output: Path) -> list[str]:
        asked.append((scan, output))
        code = "import sys; open(sys.argv[1], 'x').write('of all views')"
        return [sys.executable, "-c", code, str(output)]

    _go_on(run, live=live)
    assert asked == [(run / "part-2" / "scan.h5", run / "recon.h5")]
    assert (run / "recon.h5").read_text() == "of all views"
    assert (run / "recon.before-part-2.h5").read_text() == "of some views"
    assert (run / "report.before-part-2.html").read_text() == "of some views"
    assert [path.relative_to(run) for path in run.rglob("recon.h5")] == [Path("recon.h5")]
