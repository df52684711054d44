"""Commands from another terminal reach a running scan, and nobody waits for a dead one."""

import os
import stat
import threading
import tracemalloc
from contextlib import closing
from pathlib import Path

import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.core.errors import ConfigError
from beamline.core.events import Event, NextChosen
from beamline.core.files import create_part, create_run_folder
from beamline.core.stop import PauseRequest, StopRequest
from beamline.page.run_files import Reader, watched
from beamline.plan.passes import Choice
from beamline.scan import control
from beamline.scan.control import State, Verb, commands_taken, running, state_of, tell
from beamline.storage.run_record import RecordFile, RunRecord
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import Ran
from tests.clock import wait_until
from tests.slow_cases import others_slow


def asked(run: Path, verb: Verb) -> None:
    """Ask as another program does, and wait until it was taken."""
    request = run / "control" / verb
    request.touch()
    wait_until(lambda: not request.exists())


def test_a_run_is_paused_resumed_and_complete(tmp_path: Path) -> None:
    def pause() -> None:
        (run,) = tmp_path.iterdir()
        asked(run, Verb.PAUSE)
        asked(run, Verb.PAUSE)  # requests are obeyed one after the other: once this one is taken, the first is obeyed

    def resume(event: Event) -> None:
        if event.data.get("state") == State.PAUSED:
            (run,) = tmp_path.iterdir()
            (run / "control" / "resume").touch()

    ran = Ran(tmp_path, FakeInstrument(at={8: pause}), heard=resume)
    assert ran.error is None
    assert ran.states.count(State.PAUSED) == 1
    ran.assert_good_file(19, "complete")
    assert not (ran.folder / "control").exists()
    assert state_of(ran.folder) is State.DONE


def test_only_the_owner_may_ask_and_nothing_is_left(tmp_path: Path) -> None:
    pause = PauseRequest()
    with commands_taken(tmp_path, StopRequest(), pause):
        if os.name == "posix":
            assert (tmp_path / "control").stat().st_mode & 0o777 == 0o700
        asked(tmp_path, Verb.PAUSE)
        assert pause.reason
        (tmp_path / "control" / "resume").touch()
    assert not (tmp_path / "control").exists()


def test_the_commands_say_what_became_of_the_scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(control, "EFFECT_WITHIN", 0.3)
    runs = [tmp_path / "runs" / name for name in ("a", "b")]
    for run in runs:
        run.mkdir(parents=True)
        (run / "config.resolved.yaml").touch()
    assert "no scan is running in runs" in CliRunner().invoke(main, ["pause"]).stderr
    stop = StopRequest()
    files = [RecordFile(runs[0], RunRecord(State.ACQUIRING))]
    with commands_taken(runs[0], stop, PauseRequest()):
        assert running(Path("runs")) == [Path("runs/a")]
        result = CliRunner().invoke(main, ["stop"])
        assert result.exit_code == 0 and result.stdout == f"{Path('runs/a')}: acquiring\n"
        assert stop.stopping and not stop.aborting
        files.append(RecordFile(runs[1], RunRecord(State.PREPARING)))
        with commands_taken(runs[1], stop, PauseRequest()):
            result = CliRunner().invoke(main, ["abort"])
            assert result.exit_code == 2 and "2 scans are running in runs: a, b" in result.stderr
            assert CliRunner().invoke(main, ["abort", str(runs[1])]).exit_code == 0
            assert stop.aborting
    for file in files:
        file.close()
    assert running(Path("runs")) == []


@pytest.mark.parametrize("size", others_slow([10**9, 0]))  # of the log before; read whole, it would take minutes
def test_what_is_measured_next_is_said_only_while_the_scan_asks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "a"
    run.mkdir(parents=True)
    (run / "config.resolved.yaml").touch()
    _sparse(run / "events.jsonl", size)
    chosen: list[Choice] = []
    file, alone = RecordFile(run, RunRecord(State.ACQUIRING)), threading.Lock()

    def enter(state: State) -> None:
        with alone:  # of a scan, one thread writes its record
            file.put(RunRecord(state))

    def choose(choice: Choice) -> None:
        chosen.append(choice)
        event = NextChosen(
            1, 60, Choice.NEXT if choice is Choice.OFFSET else choice, "operator", "because", (), time=1.0
        )

        def write() -> None:
            with (run / "events.jsonl").open("a") as log:
                log.write(f"{event.to_json()}\n")

        if chosen.count(choice) == 1:  # a second time it changes nothing
            threading.Timer(0.3 if choice is Choice.RETAKE else 0, write).start()  # which is another thread's
        enter(State.TAXI)

    with commands_taken(run, StopRequest(), PauseRequest(), choose):
        refused = CliRunner().invoke(main, ["decide", "again"])
        assert (
            refused.exit_code == 2
            and "is not waiting for a decision on what to measure next: it is acquiring" in refused.stderr
        )
        assert list((run / "control").iterdir()) == [] and not chosen
        enter(State.ASKING)
        taken = CliRunner().invoke(main, ["decide", str(run), "again"])
        assert (taken.exit_code, taken.stdout) == (0, f"{run}: taxi\n") and chosen == [Choice.AGAIN]
        enter(State.ASKING)
        assert CliRunner().invoke(main, ["decide", "retake"]).exit_code == 0
        enter(State.ASKING)
        monkeypatch.setattr("beamline.cli.control._LOOKS", 5)
        twice = CliRunner().invoke(main, ["decide", "retake"])  # as the log has it from before
        assert twice.exit_code == 2 and "has made no other choice" in twice.stderr
        enter(State.ASKING)
        other = CliRunner().invoke(main, ["decide", str(run), "offset"])
        assert (
            other.exit_code == 2
            and "does not measure offset next" in other.stderr
            and "chose next instead: because" in other.stderr
        )
        (run / "control" / "enough").touch()
    file.close()
    assert not (run / "control").exists()
    for words in (["again", "again", "again"], ["sideways"], []):
        assert CliRunner().invoke(main, ["decide", *words]).exit_code == 2


def _sparse(log: Path, size: int = 10**9) -> None:
    with log.open("wb") as file:
        file.truncate(size)


LOGS = {"none": lambda log: None, "pipe": os.mkfifo, "device": lambda log: log.symlink_to("/dev/zero"), "long": _sparse}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
@pytest.mark.parametrize("kind", LOGS)
def test_a_log_that_is_none_or_has_no_end_keeps_no_command_waiting_and_fills_no_memory(
    tmp_path: Path, kind: str
) -> None:
    run = tmp_path / "runs" / "a"
    run.mkdir(parents=True)
    LOGS[kind](run / "events.jsonl")
    tracemalloc.start()
    for words in (["decide", str(run), "next"], *([verb, str(run)] for verb in Verb)):
        refused = CliRunner().invoke(main, words)
        assert refused.exit_code == 2 and f"no scan is running in {run}. Nothing was changed." in refused.stderr
    assert CliRunner().invoke(main, ["runs", str(run.parent)]).exit_code == 0
    if kind == "long":
        with closing(Reader(watched(run))) as reader:
            assert {reader.state()["frames"] for _ in range(3)} == {0}
    else:
        shown = CliRunner().invoke(main, ["watch", str(run), "--port", "0"])
        assert shown.exit_code == 5 and f"{run} is not the folder of a run" in shown.stderr
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**28


def test_a_dead_scan_is_told_and_nothing_of_the_request_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "ANSWER_WITHIN", 0.2)
    with pytest.raises(ConfigError, match="no scan is running"):
        tell(tmp_path, Verb.PAUSE)
    (tmp_path / "control").mkdir(mode=0o700)
    with pytest.raises(ConfigError, match="does not answer"):
        tell(tmp_path, Verb.PAUSE)
    assert list((tmp_path / "control").iterdir()) == []


@pytest.mark.skipif(os.name != "posix", reason="Windows has no umask and no mode")
@pytest.mark.parametrize("umask", [0o000, 0o002, 0o022])
def test_nobody_else_may_put_a_folder_in_the_place_of_ours(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        run = create_run_folder(tmp_path / "runs", "foam", 0.0)
        with commands_taken(run, StopRequest(), PauseRequest()):
            modes = [stat.S_IMODE(folder.stat().st_mode) for folder in (run, create_part(run), run / "control")]
    finally:
        os.umask(before)
    assert modes == [0o755, 0o755, 0o700]
