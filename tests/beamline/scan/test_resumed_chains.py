"""However the parts of a run ended, its joined file has the frames of all of them, or is refused and can be made."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.core.errors import BeamlineError, DataError
from beamline.core.files import JOINED, parts_of
from beamline.core.stop import StopRequest
from beamline.features.files.ingest import ingest
from beamline.features.files.validate import validate
from beamline.scan.resume import open_for_resume, recover_run
from beamline.scan.run import run_scan
from beamline.storage import parts
from beamline.storage.hdf5 import open_hdf5
from beamline.storage.parts import is_joined
from beamline.storage.readers.open import open_scan
from beamline.storage.writer_lock import QUIET
from beamline.storage.writers import layout
from beamline.storage.writers.rows import Rows
from drivers.base.errors import DeviceError
from drivers.base.frame import Frame, FrameKind
from tests.beamline.fakes import FakeInstrument, Faults
from tests.beamline.ran import killed, small

FIRST = 5  # 3 darks and 2 flats
VIEWS = 12
START, DARKS, VIEW, END = 0, 2, FIRST + 2, FIRST + 4  # frames of a part, at which it ends


class Chain:
    """A run whose parts end one after the other; `end` takes the next part, which ends so at a frame."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.patch = folder, monkeypatch
        self.config = small("scan.flats.at=both")

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
        getattr(self, f"_{how}")(at)
        for part in self.run.rglob("scan.h5"):  # all of this was a while ago
            when = part.stat().st_mtime - 2 * QUIET
            os.utime(part, (when, when))

    def _stopped(self, at: int, abort: bool = False) -> None:
        stop = StopRequest()
        act = stop.abort if abort else stop.stop
        instrument = FakeInstrument(at={at: act})
        with pytest.raises(BeamlineError):
            self.take(instrument, stop, at_start=at == START)

    def _aborted(self, at: int) -> None:
        self._stopped(at, abort=True)

    def _failed(self, at: int) -> None:
        """A device fails."""
        with pytest.raises(DeviceError):
            self.take(FakeInstrument(Faults(errors={at: 99})), StopRequest())

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
        with self.patch.context() as patch:
            patch.setattr(Rows, "write", write)
            with pytest.raises(DataError, match="No space left"):
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


def _frames(run: Path) -> int:
    """Committed frames of all parts."""
    n = 0
    for part in run.rglob("scan.h5"):
        with open_hdf5(part) as file:
            n += int(file[layout.COMMITTED][()])
    return n


def _assert_whole(joined: Path) -> None:
    with open_scan(joined) as source:
        frames = list(source.frames())
    triggers = [frame.trigger for frame in frames if frame.kind is FrameKind.PROJECTION]
    assert sorted(triggers) == list(range(VIEWS))
    assert [finding.message for finding in validate(joined, lambda done, of: None) if finding.severity == "error"] == []
    assert len(frames) == _frames(joined.parent)


CHAINS: tuple[Sequence[tuple[str, int]], ...] = (
    [("killed", VIEW), ("killed", VIEW), ("stopped", START)],
    [("killed", DARKS), ("failed", VIEW), ("killed", DARKS)],
    [("stopped", VIEW), ("unjoined_whole", START)],
    [("aborted", FIRST + VIEWS), ("aborted", START), ("killed", 0)],  # references of the end alone
)
MORE_CHAINS: tuple[Sequence[tuple[str, int]], ...] = (
    [("stopped", VIEW), ("full", VIEW), ("aborted", VIEW)],
    [("stopped", VIEW), ("unjoined", VIEW), ("stopped", START)],
    [("stopped", VIEW), ("aborted", DARKS), ("aborted", VIEW)],
    [("stopped", VIEW), ("full", DARKS), ("stopped", START)],
    [("stopped", VIEW), ("stopped", VIEW), ("unjoined_whole", START)],
)


def _named(chain: Sequence[tuple[str, int]]) -> str:
    return "-".join(f"{how}{at}" for how, at in chain)


@pytest.mark.parametrize(
    "chain",
    [
        *(pytest.param(chain, id=_named(chain)) for chain in CHAINS),
        *(pytest.param(chain, id=_named(chain), marks=pytest.mark.slow) for chain in MORE_CHAINS),
    ],
)
def test_the_joined_file_has_all_frames_or_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chain: Sequence[tuple[str, int]]
) -> None:
    made = Chain(tmp_path / "runs", monkeypatch)
    for how, at in chain:
        made.end(how, at)
        joined = made.run / JOINED
        if len([part for part in parts_of(made.run) if parts.may_hold_frames(part / "scan.h5")]) < 2:
            assert not joined.exists()
            continue
        if how in ("stopped", "aborted", "failed"):
            assert is_joined(joined)
        try:
            with open_scan(joined) as source:
                assert len(source.table) == _frames(made.run)
        except DataError as refused:
            assert "recover" in str(refused) or not joined.exists()
    if chain[-1][0] != "unjoined_whole":
        made.take(FakeInstrument(), StopRequest())
    else:
        said = CliRunner().invoke(main, ["scan", "--resume", str(made.run)])
        assert said.exit_code == 0, said.output
    _assert_whole(joined)


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
        assert len(source.table) == _frames(recovered.parent)


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
