"""Kill -9 at random moments of scan, last fit and resumption: the list of runs is right at any moment.

While a process has the run in work it is never listed as ended or dead. Afterwards it has died, or has the end that its
process wrote. In every third life the kill comes while the record is written.
"""

import json
import math
import multiprocessing
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pytest

from beamline.core.errors import ConfigError
from beamline.core.files import parts_of
from beamline.scan import recorder
from beamline.scan.control import State
from beamline.scan.resume import NoFrame, NothingMissing, NotJoined, open_for_resume, recover_run
from beamline.scan.run import run_scan
from beamline.scan.runs import Run, describe, runs_in
from beamline.storage.hdf5 import open_hdf5
from beamline.storage.run_record import RunRecord
from beamline.storage.writer_lock import QUIET
from beamline.storage.writers import layout
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import small

VIEWS, SECONDS = 40, 0.006  # s a frame, of real time
WITHIN = {"preparing": 1.0, "darks": 0.1, "acquiring": 0.3, "finishing": 0.5}  # s: a kill comes so soon after a state
ORDER = ["preparing", "darks", "flats", "taxi", "acquiring", "finishing", "done"]
IN_WORK = {state.value for state in State if not state.ended}
FIT = """
import json, sys, time
print(json.dumps({"event": "state", "state": "ready", "message": "", "time": 0.0}), flush=True)
until = time.monotonic() + 0.7
progress = {"event": "progress", "stage": "fit", "of": 1, "n": 1, "per_s": 1.0, "eta_s": 1e3, "time": 0.0}
while time.monotonic() < until:
    print("\\n".join([json.dumps(progress)] * 50), flush=True)
    time.sleep(0.01)
print(json.dumps({"event": "done", "time": 0.0, "output": "v.h5"}), flush=True)
"""

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a process that is forked is killed")


@pytest.fixture(autouse=True)
def _no_pause_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a virtual clock frames come faster than any disk takes them; a pause for it exposes frames not kept."""
    monkeypatch.setattr(recorder, "hold_for_backlog", lambda *_: None)


def _die_in_write(number: int, share: float) -> None:
    """Let this process die in the write of a record of this number, when so much of it is in its temporary file; from
    1 on: before or after it takes the place of the one before."""
    usual, writes = Path.replace, iter(range(10**6))

    def write_text(path: Path, text: str, encoding: str) -> int:
        last = path.name == ".state.json.new" and next(writes) == number
        with path.open("w", encoding=encoding) as file:
            file.write(text[: int(share * len(text))] if last else text)
        if last and share < 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return len(text)

    def replace(path: Path, target: Path) -> Path:
        last = path.name == ".state.json.new" and next(writes) == number
        if last and share < 1.5:
            os.kill(os.getpid(), signal.SIGKILL)
        done = usual(path, target)
        if last:
            os.kill(os.getpid(), signal.SIGKILL)
        return done

    Path.write_text = write_text  # type: ignore[method-assign, assignment]
    Path.replace = replace  # type: ignore[method-assign, assignment]


def _take(runs: Path, run: Path | None, in_hand: Connection, die: tuple[int, float] | None) -> None:
    """Take a run, or what it lacks; sends a byte once no other process may."""
    instrument = FakeInstrument(on_frame=lambda number: time.sleep(SECONDS))
    live = lambda scan, volume: [sys.executable, "-c", FIT]  # noqa: E731
    if die is not None:
        _die_in_write(*die)
    if run is None:
        in_hand.send_bytes(b".")
        config = small(f"scan.angles.views={VIEWS}", "scan.period_s=0.1")
        run_scan(config, runs, instrument=instrument.connected(), live=live)
        return
    instrument.clock.sleep(1e4 * len(parts_of(run)))
    try:
        with open_for_resume(run) as series:
            in_hand.send_bytes(b".")
            run_scan(series.config, series, instrument=instrument.connected(), live=live)
    except (NotJoined, NothingMissing):
        recover_run(run)
    except NoFrame:
        pass


def _stored(run: Path) -> int:
    """Committed frames of all parts, by their files."""
    n = 0
    for part in parts_of(run):
        with suppress(Exception), open_hdf5(part / "scan.h5", follow=True) as file:
            n += int(file[layout.COMMITTED][()])
    return n


def _listed(runs: Path) -> Run | None:
    folders = runs_in(runs)
    return describe(folders[0]) if folders else None


def _live(
    runs: Path, run: Path | None, kill: tuple[str, float], die: tuple[int, float] | None, counted: Counter[str]
) -> bool:
    """A life of a process that takes a run, and its end, so many seconds after it was in a state; whether it was
    killed."""
    ours, theirs = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=_take, args=(runs, run, theirs, die))
    process.start()
    theirs.close()
    assert process.pid is not None
    deadline, seen, asked = math.inf, list[Run](), False
    with suppress(EOFError):
        ours.recv_bytes()
    while time.monotonic() < deadline and process.is_alive():
        if (now := _listed(runs)) is None:
            continue
        if now.state not in IN_WORK:
            time.sleep(0.1)  # its lock goes a moment before the process that killed itself
        if not process.is_alive():
            continue
        seen.append(now)
        counted["looks"] += 1
        if now.state in ORDER[ORDER.index(kill[0]) :]:
            deadline = min(deadline, time.monotonic() + kill[1])
        if now.state == State.ACQUIRING and not asked:
            asked = True
            _assert_refused(now.folder, process)
        time.sleep(0.002)
    process.kill()
    process.join()
    died = process.exitcode == -signal.SIGKILL
    words, raw = {one.state for one in seen}, _raw(runs)
    assert words <= IN_WORK | ({raw.state} if raw is not None and raw.over else set()), (words, raw)
    assert all(one.frames is not None for one in seen)
    if died and seen:
        counted[seen[-1].state if run is None else f"{seen[-1].state} of a resumption"] += 1
    return died


def _assert_refused(run: Path, process: BaseProcess) -> None:
    """A run that a process takes is neither recovered nor resumed, unless it has ended meanwhile."""
    for take_up in (lambda: recover_run(run), lambda: ExitStack().enter_context(open_for_resume(run))):
        try:
            take_up()
        except ConfigError as error:
            assert "Nothing was changed" in str(error)
        else:
            assert not process.is_alive()


def _raw(runs: Path) -> RunRecord | None:
    """The newest record as it is in its file."""
    for run in runs_in(runs):
        for part in reversed(parts_of(run)):
            with suppress(OSError):
                return RunRecord(**json.loads((part / "state.json").read_text()))
    return None


def kills(folder: Path, n: int, seed: int) -> Counter[str]:
    """So many kills, in runs that go on after each."""
    rng, counted = np.random.default_rng(seed), Counter[str]()
    for number in _runs_until(counted, n):
        runs, run = folder / str(number), None
        for life in range(4):
            die = (int(rng.integers(0, 9)), float(rng.choice([0.0, 0.5, 1.0, 2.0]))) if rng.random() < 0.34 else None
            state = str(rng.choice([*WITHIN])) if die is None and life < 3 else ORDER[-1]
            kill = state, rng.uniform(0, WITHIN.get(state, 0.0))
            killed = _live(runs, run, kill, None if life == 3 else die, counted)
            counted["kills"] += killed
            counted["kills in the record"] += killed and die is not None
            if (now := _listed(runs)) is None:
                break
            run, raw = now.folder, _raw(runs)
            assert raw is not None
            assert now.state == (raw.state if raw.over else "died"), (now, raw)
            assert now.frames == _stored(run), (now, raw)
            if not killed and now.frames:  # `failed`: all was there, and recovered, but no process closed the file
                assert now.state in (State.DONE, State.FAILED) and now.frames >= (now.planned or 0)
                counted["whole"] += 1
                break
            for file in run.rglob("*"):
                os.utime(file, (time.time() - 2 * QUIET,) * 2)
    return counted


def _runs_until(counted: Counter[str], n: int) -> Iterator[int]:
    number = 0
    while counted["kills"] < n:
        yield number
        number += 1


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_few_kills(tmp_path: Path) -> None:
    counted = kills(tmp_path, 8, 1)
    assert counted["looks"] > 100


@pytest.mark.bench
@pytest.mark.timeout(3600)
def test_two_hundred_kills(tmp_path: Path) -> None:
    counted = kills(tmp_path, 200, 0)
    print(dict(sorted(counted.items())))
    in_fits = counted[State.FINISHING] + counted["finishing of a resumption"]
    assert counted["kills in the record"] > 20 and in_fits > 10
