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
from beamline.projections.preparation import Preparation
from beamline.projections.prepare import prepare_projections
from beamline.projections.selection import Selection
from beamline.projections.views import checked_views, select
from beamline.scan import control
from beamline.scan.control import State, Verb, running, tell
from beamline.scan.resume import open_for_resume
from beamline.scan.run import run_scan
from beamline.storage.hdf5 import open_hdf5
from beamline.storage.interrupted import whole_scan
from beamline.storage.readers.open import open_scan
from beamline.storage.readers.reference_files import overlaid
from beamline.storage.writer_lock import WriterLock
from beamline.storage.writers import layout
from drivers.base.frame import FrameKind
from tests.beamline.fakes import FakeInstrument, Faults, assert_true
from tests.beamline.ran import Ran, ended_run, small
from tests.messages import refused
from tests.slow_cases import others_slow

FIRST = 5  # 3 darks and 2 flats
VIEWS = 12


@pytest.fixture(scope="module")
def aborted_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ended_run(tmp_path_factory.mktemp("runs"), "aborted", at=FIRST + 4)


@pytest.fixture
def run(aborted_once: Path, tmp_path: Path) -> Path:
    """A run with four views."""
    return shutil.copytree(aborted_once, tmp_path / "runs" / aborted_once.name)


def go_on(run: Path, instrument: FakeInstrument | None = None, **more: object) -> RunResult:
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


def _assert_told_of_parts(run: Path) -> None:
    """Each part names the joined file, which speaks of no other, and is not reconstructed by itself."""
    for part in (run / "scan.h5", run / "part-2/scan.h5"):
        line = f"This file is one of 2 parts of a scan: use {run / 'joined.h5'}, which has the frames of all parts."
        assert sum(finding.startswith(line) for finding in describe(part)["findings"]) == 1
        with open_scan(part) as source, pytest.raises(DataError, match=re.escape(line)):
            accepting = Selection(steps=(Preparation(references="accept"),))
            checked_views(select(source, accepting), lambda _: None)
        assert whole_scan(part) == run / "joined.h5" == watched(part).scan
    with closing(Reader(watched(run))) as reader:
        assert reader.state()["frames"] == open_scan(run / "joined.h5").table.kinds.size
    facts = describe(run / "joined.h5")
    assert not any("parts of a scan" in finding for finding in facts["findings"])
    assert facts["kinds"]["projection"] == VIEWS
    assert facts["attributes"]["status"] == "complete"
    assert (facts["missing_triggers"], facts["attributes"]["parts"]) == (0, "scan.h5, part-2/scan.h5")


@pytest.mark.slow
def test_the_views_of_all_parts_are_corrected_together(run: Path, tmp_path: Path) -> None:
    go_on(run)
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
        prepared = prepare_projections(select(source, selection), lambda said: None)
    assert len(prepared.seen.data) == VIEWS


def _aborted(runs: Path, *overrides: str, at: int) -> Path:
    return ended_run(runs, "aborted", *overrides, at=at)


def _without_a_flat(runs: Path, *overrides: str, at: int) -> Path:
    ran = Ran(runs, FakeInstrument(Faults(lost={at + 1})), *overrides)
    return ran.folder


@pytest.mark.parametrize(
    ("end", "taken", "overrides"),
    others_slow(
        [
            (_aborted, "FFDDD", ("scan.darks.at=both", "scan.mode=step")),
            (_without_a_flat, "FF", ()),
            (_aborted, "FF", ("scan.flats.at=end",)),
        ]
    ),
)
def test_references_of_the_end_alone_are_taken(
    tmp_path: Path, end: Callable[..., Path], taken: str, overrides: tuple[str, ...]
) -> None:
    at = (3 if "scan.flats.at=end" in overrides else FIRST) + VIEWS  # the first flat after the views
    run = end(tmp_path, *overrides, at=at)
    with open_hdf5(run / "scan.h5") as first:
        before = int((first[layout.KIND][()] != FrameKind.PROJECTION).sum())
    instrument = FakeInstrument()
    result = go_on(run, instrument)
    assert (result.path, result.missing) == (run / "joined.h5", ())
    with h5py.File(run / "part-2/scan.h5") as part:
        assert "".join(FrameKind(kind).name[0] for kind in part[layout.KIND][()]) == taken
    assert not any(told == "arm stage" for told in instrument.log)
    _assert_whole(run / "joined.h5", before + len(taken))
    assert [finding for finding in validate(run / "joined.h5") if finding.severity == "error"] == []
    assert describe(run / "joined.h5")["missing_triggers"] == 0
    with open_scan(run / "joined.h5") as source:
        scan = select(source, Selection(axis_col=5.5, steps=(Air("none"), Preparation("ignore", "accept"))))
        prepared = prepare_projections(scan, lambda said: None)
    assert len(prepared.seen.data) == VIEWS
    with pytest.raises(ConfigError, match="all projections, darks and flats that were planned"):
        go_on(run)


def test_a_stop_before_references_of_the_end_leaves_the_run_as_it_was(tmp_path: Path) -> None:
    run = ended_run(tmp_path, "aborted", at=FIRST + VIEWS)
    stop = StopRequest()
    with open_for_resume(run) as series:
        assert series.in_words.endswith(
            "has all 12 projections; the flats that are missing at the end of the run are taken now"
        )
        with refused(BeamlineError):
            run_scan(
                series.config, series, [lambda event: stop.stop() if event.event == "run_started" else None], stop,
                instrument=FakeInstrument().connected(),
            )  # fmt: skip
    assert not (run / "joined.h5").exists()
    assert go_on(run).n_frames == FIRST + VIEWS + 1 + 2


def test_verbs_reach_the_newest_part(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "EFFECT_WITHIN", 0.2)
    told: list[tuple[list[Path], str]] = []

    with refused(BeamlineError):
        go_on(run, FakeInstrument(at={FIRST: lambda: told.append((running(run.parent), tell(run, Verb.ABORT)))}))
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
        (_other_exposure, "another configuration: `exposure_s: 0.02` instead of `exposure_s: 0.03`"),
        (_without_plan, "has no plan"),
        (_other_camera, "another camera: model another one; now it is model fake camera"),
    ],
)
def test_what_cannot_go_on_is_refused_in_one_line(run: Path, change: Callable[[Path], None], said: str) -> None:
    change(run)
    before = {path: _digest(path) for path in run.rglob("*") if path.is_file()}
    with pytest.raises(BeamlineError, match=said) as refused:
        go_on(run)
    assert "\n" not in str(refused.value)
    assert "Nothing was changed" in str(refused.value)
    assert {path: _digest(path) for path in run.rglob("*") if path.is_file()} == before


def test_a_run_that_another_process_holds_is_refused(run: Path) -> None:
    lock = WriterLock(run / "scan.h5")
    with pytest.raises(DataError, match="open in a program that is still running"):
        go_on(run)
    lock.release()
    with open_for_resume(run), pytest.raises(ConfigError, match="another process is continuing"):
        go_on(run)
    with (
        pytest.raises(ConfigError, match="configuration: `views: 12`"),
        open_for_resume(run, small("scan.angles.views=24")),
    ):
        pass
    assert not (run / "part-2").exists()


def test_the_volume_of_all_parts_is_that_of_the_run(tmp_path: Path) -> None:
    run = ended_run(tmp_path, "stopped", at=8)
    (run / "recon.h5").write_text("of some views")
    (run / "report.html").write_text("of some views")
    asked: list[tuple[Path, Path]] = []

    def live(scan: Path, output: Path) -> list[str]:
        asked.append((scan, output))
        code = "import sys; open(sys.argv[1], 'x').write('of all views')"
        return [sys.executable, "-c", code, str(output)]

    go_on(run, live=live)
    assert asked == [(run / "part-2" / "scan.h5", run / "recon.h5")]
    assert (run / "recon.h5").read_text() == "of all views"
    assert (run / "recon.before-part-2.h5").read_text() == "of some views"
    assert (run / "report.before-part-2.html").read_text() == "of some views"
    assert [path.relative_to(run) for path in run.rglob("recon.h5")] == [Path("recon.h5")]
