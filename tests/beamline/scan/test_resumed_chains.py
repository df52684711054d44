"""However the parts of a run ended, its joined file has the frames of all of them, or is refused and can be made."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from beamline.cli.main import main
from beamline.core.errors import BeamlineError, DataError
from beamline.core.files import JOINED, parts_of
from beamline.core.stop import StopRequest
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import validate
from beamline.scan.resume import NoFrame, NothingMissing, NotJoined, open_for_resume, recover_run
from beamline.scan.run import run_scan
from beamline.scan.runs import describe
from beamline.storage import parts
from beamline.storage.hdf5 import open_hdf5
from beamline.storage.parts import is_joined
from beamline.storage.readers.open import open_scan
from beamline.storage.writer_lock import QUIET
from beamline.storage.writers import layout
from beamline.storage.writers.rows import Rows
from drivers.base.errors import DeviceError
from drivers.base.frame import Frame, FrameKind
from tests.beamline.fakes import FakeInstrument, Faults, assert_true
from tests.beamline.ran import killed, small
from tests.slow_cases import others_slow

FIRST = 5  # 3 darks and 2 flats
VIEWS = 12
START, DARKS, VIEW, END, LAST = 0, 2, FIRST + 2, FIRST + 4, FIRST + VIEWS  # frames of a part, at which it ends


MODES = {
    "fly": ("scan.mode=fly",),
    "step": ("scan.mode=step",),
    "interlaced": ("scan.mode=fly", "scan.angles={scheme: interlaced, views: 12, passes: 2}"),
    "backwards": ("scan.mode=fly", "scan.angles={scheme: fixed, views: 12, start_deg: 90, span_deg: -180}"),
}
ENDS = "stopped", "aborted", "failed", "killed", "full", "lossy", "unjoined"


class Chain:
    """A run whose parts end one after the other; `end` takes the next part, which ends so at a frame, if it has one of
    that number."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch, mode: str = "fly") -> None:
        self.folder, self.patch = folder, patch
        self.config = small("scan.flats.at=both", *MODES[mode])

    @property
    def run(self) -> Path:
        (run,) = self.folder.iterdir()
        return run

    def take(self, instrument: FakeInstrument, stop: StopRequest, at_start: bool = False) -> None:
        """The run's next part, whatever it ends with."""
        started = (lambda event: stop.stop() if event.event == "run_started" else None) if at_start else None
        sinks = [] if started is None else [started]
        devices = instrument.connected()
        if not self.folder.exists():
            run_scan(self.config, self.folder, sinks, stop, instrument=devices)
            return
        instrument.clock.sleep(1000.0 * len(parts_of(self.run)))
        with open_for_resume(self.run) as series:
            run_scan(series.config, series, sinks, stop, instrument=devices)

    def end(self, how: str, at: int) -> None:
        with suppress(BeamlineError, DeviceError):
            getattr(self, f"_{how}")(at)
        for part in self.run.rglob("scan.h5"):  # all of this was a while ago
            when = part.stat().st_mtime - 2 * QUIET
            os.utime(part, (when, when))

    def _stopped(self, at: int, abort: bool = False) -> None:
        stop = StopRequest()
        instrument = FakeInstrument(at={at: stop.abort if abort else stop.stop})
        self.take(instrument, stop, at_start=at == START)

    def _aborted(self, at: int) -> None:
        self._stopped(at, abort=True)

    def _failed(self, at: int) -> None:
        """A device fails."""
        self.take(FakeInstrument(Faults(errors={at: 99})), StopRequest())

    def _lossy(self, at: int) -> None:
        """To its end, with views lost, two of them side by side, and the last."""
        self.take(FakeInstrument(Faults(lost={at}, ignored={at + 1, FIRST + VIEWS - 1})), StopRequest())

    def _killed(self, at: int) -> None:
        """As kill -9 leaves it: the newest part marked as being written, the joined file as it was."""
        with killed(self.patch), self._joined_stays():
            self._aborted(at)

    def _full(self, at: int) -> None:
        """The disk takes no frame from one on; its file is never closed, as in a process that has ended since."""

        def write(table: Rows, frame: Frame, *given: Any) -> None:
            if frame.index == at:
                raise OSError(errno.ENOSPC, "No space left on device")
            usual(table, frame, *given)

        usual = Rows.write
        with self.patch.context() as patch, pytest.raises(DataError, match="No space left"):
            patch.setattr(Rows, "write", write)
            self.take(FakeInstrument(), StopRequest())
        part = parts_of(self.run)[-1] / "scan.h5"
        shutil.copy(part, part.with_name("died.h5"))
        part.with_name("died.h5").replace(part)

    def _unjoined(self, at: int) -> None:
        """As kill -9 leaves it while the parts are joined."""
        with self._joined_stays():
            self._aborted(at)

    def _unjoined_whole(self, at: int) -> None:
        with self._joined_stays():
            self.take(FakeInstrument(), StopRequest())

    def _joined_stays(self) -> _Stays:
        return _Stays(self.run / JOINED if self.folder.exists() else None)


class _Stays:
    """What is made of a file in the block is undone at its end."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.before = path.read_bytes() if path is not None and path.exists() else None

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None:
        if self.path is not None:
            self.path.unlink(missing_ok=True)
            if self.before is not None:
                self.path.write_bytes(self.before)


def _rows(run: Path) -> list[tuple[int, int]]:
    """Kind and trigger of the committed frames of all parts, by their files."""
    found: list[tuple[int, int]] = []
    for part in parts_of(run):
        if parts.may_hold_frames(part / "scan.h5"):
            with open_hdf5(part / "scan.h5") as file:
                n = int(file[layout.COMMITTED][()])
                found += zip(file[layout.KIND][:n].tolist(), file[layout.TRIGGER][:n].tolist(), strict=True)
    return found


def _views(run: Path) -> list[int]:
    return sorted(trigger for kind, trigger in _rows(run) if kind == FrameKind.PROJECTION)


def _assert_whole(path: Path) -> None:
    """Each view once, at its angle and with the pixels of its angle, and all other frames of the parts."""
    with open_scan(path) as source:
        frames = list(source.frames())
    assert_true(frames)
    assert sorted((int(frame.kind), frame.trigger) for frame in frames) == sorted(_rows(path.parent))
    assert _views(path.parent) == list(range(VIEWS))
    assert [finding.message for finding in validate(path, lambda done, of: None) if finding.severity == "error"] == []
    with h5py.File(path) as file:  # as another program reads it
        assert len(file["exchange/data"]) == VIEWS


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


class PartsOfARun(RuleBasedStateMachine):
    """Whatever its parts end with, and whatever is done between them: the joined file has the frames of all or is
    refused, files that were closed stay as they are, and what is still missing, and no more, is taken at last."""

    def __init__(self) -> None:
        super().__init__()
        self.patch, self.temporary = pytest.MonkeyPatch(), TemporaryDirectory()
        self.closed: dict[Path, str] = {}

    @initialize(mode=st.sampled_from([*MODES]), how=st.sampled_from(ENDS), at=st.sampled_from([DARKS, VIEW, LAST]))
    def begin(self, mode: str, how: str, at: int) -> None:
        self.chain = Chain(Path(self.temporary.name) / "runs", self.patch, mode)
        self._end(how, at)

    @rule(how=st.sampled_from(ENDS), at=st.sampled_from([START, DARKS, VIEW, END]))
    def end_another_part(self, how: str, at: int) -> None:
        self._end(how, at)

    def _end(self, how: str, at: int) -> None:
        before = len(parts_of(self.run)) if self.chain.folder.exists() else 0
        self.chain.end(how, at)
        taken = len(parts_of(self.run)) > before  # of a run with all its frames none is
        if taken and how in ("stopped", "aborted", "failed") and len(self._parts_with_frames()) > 1:
            assert is_joined(self.joined)
        for part in parts_of(self.run):
            file = part / "scan.h5"
            if parts.may_hold_frames(file) and self._was_closed(file):
                self.closed.setdefault(file, _digest(file))

    @rule()
    def recover(self) -> None:
        before = _rows(self.run)
        with suppress(DataError):  # it has no frame
            recover_run(self.run)
            assert _rows(self.run) == before and not any(done.changed for done in recover_run(self.run)[0])

    @rule()
    def look(self) -> None:
        """What a resumption would take is what the files lack."""
        try:
            with open_for_resume(self.run) as series:
                assert sorted(series.views) == _views(self.run)
        except (NothingMissing, NotJoined) as ended:
            assert _views(self.run) == list(range(VIEWS)) and isinstance(ended, NotJoined) is not self._is_joined()
        except NoFrame:
            assert _rows(self.run) == []

    @rule()
    def lose_the_joined_file(self) -> None:
        self.joined.unlink(missing_ok=True)

    @rule(content=st.sampled_from([b"", b"\xff"]))
    def lose_the_newest_events(self, content: bytes) -> None:
        """The file of the part says what it has; one that has nothing may be empty."""
        first, *_, newest = [*parts_of(self.run)[:1], *parts_of(self.run)]
        if newest != first:
            (newest / "events.jsonl").write_bytes(content)
            if newest / "scan.h5" not in self._parts_with_frames():
                (newest / "scan.h5").write_bytes(b"")

    @rule()
    def spoil_a_view(self) -> None:
        """It is taken again."""
        (file, *others) = self._parts_with_frames()
        views = [trigger for kind, trigger in _rows(self.run) if kind == FrameKind.PROJECTION]
        if others or file not in self.closed or not views:
            return
        with h5py.File(file, "r+", libver=layout.LIBVER) as opened:
            row = int(np.flatnonzero(opened[layout.KIND][()] == FrameKind.PROJECTION)[0])
            opened[layout.KIND][row] = opened[layout.IMAGE_KEY][row] = FrameKind.INVALID
        self.closed[file] = _digest(file)

    @invariant()
    def the_joined_file_has_all_frames_or_is_refused(self) -> None:
        if not hasattr(self, "chain"):
            return
        if len(self._parts_with_frames()) < 2:
            assert not self.joined.exists()
            return
        try:
            with open_scan(self.joined) as source:
                assert len(source.table) == len(_rows(self.run))
        except DataError as refused:
            assert "recover" in str(refused) or not self.joined.exists()

    @invariant()
    def the_list_of_runs_says_what_became_of_it(self) -> None:
        if hasattr(self, "chain"):
            now, record = describe(self.run), json.loads((parts_of(self.run)[-1] / "state.json").read_text())
            assert (now.frames, now.state) == (len(_rows(self.run)), record["state"] if record["over"] else "died")

    def teardown(self) -> None:
        try:
            if hasattr(self, "chain"):
                self._finish()
        finally:
            self.patch.undo()
            self.temporary.cleanup()

    def _finish(self) -> None:
        if not _rows(self.run):
            with pytest.raises(NoFrame):
                self.chain.take(FakeInstrument(), StopRequest())
            return
        missing, known = VIEWS - len(_views(self.run)), len(_rows(self.run))
        try:
            self.chain.take(FakeInstrument(), StopRequest())
            kinds = [kind for kind, _ in _rows(self.run)[known:]]
            references = FIRST + 2 if missing else 2  # with the views all are taken, at last those of the end alone
            assert (kinds.count(FrameKind.PROJECTION), len(kinds)) == (missing, missing + references)
        except NotJoined:
            assert missing == 0 and not self._is_joined()
            said = CliRunner().invoke(main, ["scan", "--resume", str(self.run)])
            assert said.exit_code == 0, said.output
        except NothingMissing:
            assert missing == 0 and self._is_joined()
        assert [kind for kind, _ in _rows(self.run)[-2:]] == [FrameKind.FLAT] * 2  # those of the end
        _assert_whole(self.joined if self.joined.exists() else self.run / "scan.h5")
        for file, digest in self.closed.items():
            assert _digest(file) == digest
        with pytest.raises(NothingMissing), open_for_resume(self.run):
            ...

    @property
    def run(self) -> Path:
        return self.chain.run

    @property
    def joined(self) -> Path:
        return self.run / JOINED

    def _is_joined(self) -> bool:
        """There is one closed file of all frames."""
        files = self._parts_with_frames()
        return all(map(self._was_closed, files)) and (len(files) == 1 or is_joined(self.joined))

    def _parts_with_frames(self) -> list[Path]:
        return [part / "scan.h5" for part in parts_of(self.run) if parts.may_hold_frames(part / "scan.h5")]

    @staticmethod
    def _was_closed(file: Path) -> bool:
        try:
            h5py.File(file).close()
        except OSError:  # marked as open for writing
            return False
        return True


@pytest.mark.timeout(1200)
@pytest.mark.parametrize(("runs", "steps"), others_slow([(3, 4), (15, 7)]))
def test_any_order(runs: int, steps: int) -> None:
    drawn = settings(max_examples=runs, stateful_step_count=steps, deadline=None, phases=[Phase.generate])
    run_state_machine_as_test(PartsOfARun, settings=drawn)


@pytest.mark.parametrize(
    ("mode", "steps"),
    [
        ("step", [("killed", VIEW), ("killed", VIEW), ("stopped", START)]),
        ("fly", [("killed", DARKS), ("failed", VIEW), ("killed", DARKS)]),
        ("interlaced", [("stopped", VIEW), ("unjoined_whole", START)]),
        ("backwards", [("aborted", LAST), ("aborted", START), ("killed", 0)]),  # references of the end alone
        ("fly", [("lossy", FIRST + 2), ("full", DARKS), ("aborted", VIEW)]),
    ],
)
def test_named_orders(mode: str, steps: list[tuple[str, int]]) -> None:
    made = PartsOfARun()
    try:
        made.begin(mode=mode, how=steps[0][0], at=steps[0][1])
        for how, at in steps[1:]:
            made.the_joined_file_has_all_frames_or_is_refused()
            made.the_list_of_runs_says_what_became_of_it()
            made.end_another_part(how=how, at=at)
            made.look()
    finally:
        made.teardown()


@pytest.fixture(scope="module")
def killed_while_joined(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        chain = Chain(tmp_path_factory.mktemp("chain") / "runs", patch)
        chain.end("stopped", VIEW)
        chain.end("stopped", VIEW)
        chain.end("unjoined_whole", START)
        return chain.run


@pytest.fixture(scope="module")
def recovered_once(killed_while_joined: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = shutil.copytree(killed_while_joined, tmp_path_factory.mktemp("recovered") / "run")
    recover_run(run)
    _assert_whole(run / JOINED)
    return run


@pytest.fixture
def recovered(recovered_once: Path, tmp_path: Path) -> Path:
    """The joined file of all three parts."""
    return shutil.copytree(recovered_once, tmp_path / "run") / JOINED


def _beamline(*words: str | Path) -> tuple[int, str]:
    said = CliRunner().invoke(main, [str(word) for word in words])
    return said.exit_code, said.output


def _fewer_frames(run: Path) -> None:
    with h5py.File(run / "part-2" / "scan.h5", "r+") as file:
        file[layout.COMMITTED][()] -= 1


def _gone(run: Path) -> None:
    (run / "part-3" / "scan.h5").unlink()


def _torn(run: Path) -> None:
    whole = (run / JOINED).read_bytes()
    (run / JOINED).write_bytes(whole[: len(whole) // 2])


def _without_its_parts(run: Path) -> None:
    with h5py.File(run / JOINED, "r+") as file:
        del file[layout.PARTS]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_fewer_frames, "part-2/scan.h5 has .* frames, not the"),
        (_gone, "part-3/scan.h5 is not there"),
        (_torn, "is cut off"),
        (_without_its_parts, "does not say what its parts are"),
    ],
)
def test_a_joined_file_whose_parts_changed_is_refused_and_made_again(
    recovered: Path, change: Callable[[Path], None], said: str
) -> None:
    change(recovered.parent)
    with pytest.raises(DataError, match=said.replace("/", r"[/\\]")):
        open_scan(recovered)
    recover_run(recovered.parent)
    with open_scan(recovered) as source:
        assert len(source.table) == len(_rows(recovered.parent))


def test_a_run_is_copied_as_a_whole_and_its_copy_needs_no_part(recovered: Path, tmp_path: Path) -> None:
    shutil.copytree(recovered.parent, tmp_path / "copy")
    _assert_whole(tmp_path / "copy" / JOINED)
    (tmp_path / "alone").mkdir()
    shutil.copy(recovered, tmp_path / "alone")
    with pytest.raises(DataError, match="as a whole"):
        open_scan(tmp_path / "alone" / JOINED)
    ingest(recovered, tmp_path / "archive.h5")
    shutil.copy(tmp_path / "archive.h5", recovered.parent / "archive.h5")
    shutil.copy(tmp_path / "archive.h5", tmp_path / "alone" / JOINED)
    with open_scan(recovered) as source:
        n = len(source.table)
        for copy in (tmp_path / "archive.h5", recovered.parent / "archive.h5", tmp_path / "alone" / JOINED):
            with open_scan(copy) as archived:
                np.testing.assert_array_equal(archived.read(slice(None)), source.read(slice(None)))
    assert _beamline("recover", tmp_path / "alone" / JOINED) == (
        0,
        f"{tmp_path / 'alone' / JOINED} is in order, with {n} frames; nothing was changed.\n",
    )


def test_while_a_later_part_grows_the_joined_file_is_refused(recovered: Path) -> None:
    """It has the frames of the parts before, and the scan goes on."""
    shutil.copytree(recovered.parent / "part-3", recovered.parent / "part-4")
    with h5py.File(recovered.parent / "part-4" / "scan.h5", "r+") as file:
        file[layout.FINISHED][()] = 0
    with pytest.raises(DataError, match=r"lacks those of .*part-4"):
        open_scan(recovered)
