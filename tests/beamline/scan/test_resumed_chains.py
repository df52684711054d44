"""In any order of endings, the joined file of a run has all frames, or there is an error and it can be made later."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from beamline.cli.main import main
from beamline.core.errors import DataError
from beamline.core.files import JOINED, parts_of
from beamline.core.stop import StopRequest
from beamline.scan.resume import NoFrame, NothingMissing, NotJoined, open_for_resume, recover_run
from beamline.scan.runs import describe
from beamline.storage import parts
from beamline.storage.parts import is_joined
from beamline.storage.readers.open import open_scan
from beamline.storage.writers import layout
from drivers.base.frame import FrameKind
from tests.beamline.fakes import FakeInstrument
from tests.beamline.scan.chains import (
    DARKS,
    END,
    ENDS,
    FIRST,
    LAST,
    MODES,
    START,
    VIEW,
    VIEWS,
    Chain,
    assert_whole,
    rows_of,
    views_of,
)


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
        before = rows_of(self.run)
        with suppress(DataError):  # it has no frame
            recover_run(self.run)
            assert rows_of(self.run) == before and not any(done.changed for done in recover_run(self.run)[0])

    @rule()
    def look(self) -> None:
        """What a resumption would take is what the files lack."""
        try:
            with open_for_resume(self.run) as series:
                assert sorted(series.views) == views_of(self.run)
        except (NothingMissing, NotJoined) as ended:
            assert views_of(self.run) == list(range(VIEWS)) and isinstance(ended, NotJoined) is not self._is_joined()
        except NoFrame:
            assert rows_of(self.run) == []

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
        views = [trigger for kind, trigger in rows_of(self.run) if kind == FrameKind.PROJECTION]
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
                assert len(source.table) == len(rows_of(self.run))
        except DataError as refused:
            assert "recover" in str(refused) or not self.joined.exists()

    @invariant()
    def the_list_of_runs_says_what_became_of_it(self) -> None:
        if hasattr(self, "chain"):
            now, record = describe(self.run), json.loads((parts_of(self.run)[-1] / "state.json").read_text())
            assert (now.frames, now.state) == (len(rows_of(self.run)), record["state"] if record["over"] else "died")

    def teardown(self) -> None:
        try:
            if hasattr(self, "chain"):
                self._finish()
        finally:
            self.patch.undo()
            self.temporary.cleanup()

    def _finish(self) -> None:
        if not rows_of(self.run):
            with pytest.raises(NoFrame):
                self.chain.take(FakeInstrument(), StopRequest())
            return
        missing, known = VIEWS - len(views_of(self.run)), len(rows_of(self.run))
        try:
            self.chain.take(FakeInstrument(), StopRequest())
            kinds = [kind for kind, _ in rows_of(self.run)[known:]]
            references = FIRST + 2 if missing else 2  # with the views all are taken, at last those of the end alone
            assert (kinds.count(FrameKind.PROJECTION), len(kinds)) == (missing, missing + references)
        except NotJoined:
            assert missing == 0 and not self._is_joined()
            said = CliRunner().invoke(main, ["scan", "--resume", str(self.run)])
            assert said.exit_code == 0, said.output
        except NothingMissing:
            assert missing == 0 and self._is_joined()
        assert [kind for kind, _ in rows_of(self.run)[-2:]] == [FrameKind.FLAT] * 2  # those of the end
        assert_whole(self.joined if self.joined.exists() else self.run / "scan.h5")
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
@pytest.mark.parametrize(("runs", "steps"), [(2, 4), pytest.param(9, 7, marks=[pytest.mark.slow, pytest.mark.long])])
def test_any_order(runs: int, steps: int) -> None:
    drawn = settings(max_examples=runs, stateful_step_count=steps, deadline=None, phases=[Phase.generate])
    run_state_machine_as_test(PartsOfARun, settings=drawn)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "steps"),
    [
        ("step", [("killed", VIEW), ("killed", VIEW), ("stopped", START)]),
        ("fly", [("lossy", FIRST + 2), ("full", DARKS), ("aborted", VIEW)]),
        ("fly", [("killed", DARKS), ("failed", VIEW), ("killed", DARKS)]),
        ("interlaced", [("stopped", VIEW), ("unjoined_whole", START)]),
        ("backwards", [("aborted", LAST), ("aborted", START), ("killed", 0)]),  # references of the end alone
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
