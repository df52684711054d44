"""The live reconstruction of a scan: its events appear with ours; whatever happens to it, no frame is lost."""

import json
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from beamline.cli.recon import recon as recon_command
from beamline.core.errors import ScanStopped
from beamline.core.events import Event
from beamline.core.files import CONTROL
from beamline.core.process import ChildProcess, ProcessEnd
from beamline.core.recon_events import LawMeasured
from beamline.core.run_result import RunResult
from beamline.core.stop import ScanAborted, StopRequest
from beamline.plan.passes import Choice
from beamline.scan import live_process
from beamline.scan import measurement as module
from beamline.scan.live_plan import LivePlan
from beamline.scan.live_process import Commands, LiveReconstruction, Standby, commands_of, follow_command
from beamline.scan.run import run_scan
from tests.beamline.chosen import Scripted, choosing
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import Ran, small
from tests.clock import wait_until
from tests.slow_cases import others_slow


def test_what_it_leaves_out_is_told_to_the_follower() -> None:
    words = follow_command(small(), LivePlan(4, 2, 10**9))(Path("scan.h5"), Path("recon.h5"))
    assert words[words.index("--bin") + 1] == "4" and words[words.index("--views") + 1] == "every:2"
    assert "--bin" not in follow_command(small())(Path("scan.h5"), Path("recon.h5"))
    told = small("recon.live=true", f"recon.reference={Path(__file__)}")  # any file that exists
    how = commands_of(told)
    assert how.live is not None and how.afterwards is not None and how.draws
    for command, follows in ((how.live, True), (how.afterwards, False)):
        words = command(Path("scan.h5"), Path("recon.h5"))
        assert words[words.index("--method") + 1] == "from-reference" and ("--follow" in words) is follows
        assert words[words.index("--reference") + 1] == str(Path(__file__)) and "--seconds" not in words
        recon_command.make_context("recon", list(words[4:]))  # the command understands it
    words = follow_command(small(), earlier=[Path("a.h5"), Path("b.h5")])(Path("c.h5"), Path("recon.h5"))
    assert words[words.index("--follow") :][:5] == ["--follow", "--previous-part", "a.h5", "--previous-part", "b.h5"]


WAITS = "Waiting until the live reconstruction has compiled its kernels"
READY = """print('{"event": "state", "state": "ready", "message": ""}', flush=True)\n"""


def script(code: str, ready: str = READY) -> Callable[[Path, Path], Sequence[str]]:
    return lambda scan, output: [sys.executable, "-c", ready + code, str(scan), str(output)]


def test_live_reconstruction_tells_its_story_among_ours(tmp_path: Path) -> None:
    code = """
import json, pathlib, sys
print(json.dumps({"event": "snapshot", "time": 1.0, "path": "v", "picture": "p", "n_views": 5,
                  "seconds": 1.0, "unlearnt": None}))
print("a library's chatter")
pathlib.Path(sys.argv[2]).write_text("volume")
print(json.dumps({"event": "done", "time": 2.0, "output": sys.argv[2], "axis_col": 80.5}))
"""
    ran = Ran(tmp_path, FakeInstrument(), live=script(code))
    recon = [(e.event, e.data["source"]) for e in ran.events if "source" in e.data]
    assert recon == [("state", "recon"), ("snapshot", "recon"), ("recon_done", "recon")]
    assert ran.result.recon is not None
    assert ran.result.recon["axis_col"] == 80.5
    assert Path(ran.result.recon["output"]) == ran.folder / "recon.h5"
    assert ran.events[-1].event == "done"
    ran.assert_good_file(19, "complete")


@pytest.mark.parametrize("patience", [100.0, 0.0])
def test_no_view_is_taken_before_it_is_ready_or_the_time_to_wait_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, patience: float
) -> None:
    monkeypatch.setattr(module, "READY_WITHIN", patience)
    waits_for = "block_started" if patience else "scan_done"  # which would never come, were the patience not over
    compiles = (
        f"""
import pathlib, sys, time
events = pathlib.Path(sys.argv[1]).with_name("events.jsonl")
while "{waits_for}" not in events.read_text():
    time.sleep(0.05)
"""
        + READY
    )
    ran = Ran(tmp_path, FakeInstrument(), live=script(compiles, ready=""))
    assert ran.error is None
    names = [(event.event, event.data.get("state")) for event in ran.events]
    blocks = [i for i, (name, _) in enumerate(names) if name == "block_started"]
    views = next(i for i in blocks if ran.events[i].data["kind"] == "projection")
    warned = any("still loading after 0 s" in text for text in ran.warnings)
    told = [i for i, event in enumerate(ran.events) if WAITS in event.data.get("message", "")]
    assert all(blocks[0] < i < views and ran.events[i].data["state"] == "flats" for i in told)
    assert len(told) == 1 or not warned  # one that is ready by then is not waited for
    assert warned == (patience == 0)
    assert warned or names.index(("state", "ready")) < views
    assert blocks[0] < views  # darks and flats of a simulated instrument are taken meanwhile
    if not warned:
        assert blocks[0] < names.index(("state", "ready"))


def test_a_pause_that_is_asked_for_in_the_wait_is_taken_back(tmp_path: Path) -> None:
    def pause_and_resume(event: Event) -> None:
        if WAITS in event.data.get("message", ""):
            run = next(tmp_path.glob("*/"))
            for verb in ("pause", "resume"):
                (run / CONTROL / verb).touch()
                wait_until(lambda: not (run / CONTROL / verb).exists())  # noqa: B023
            (run / "go").touch()

    wait = "import pathlib, sys, time\nwhile not pathlib.Path(sys.argv[1]).with_name('go').exists(): time.sleep(0.05)\n"
    ran = Ran(tmp_path, FakeInstrument(), live=script(wait + READY, ready=""), heard=pause_and_resume)
    assert ran.error is None
    assert "paused" not in [event.data.get("state") for event in ran.events]
    ran.assert_good_file(19, "complete")


def test_a_stop_ends_the_wait_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_process, "ASK_LIVE_AFTER", 0.0)
    stop, idle = StopRequest(), "import time; time.sleep(100)"

    def stop_after_flats(event: Event) -> None:
        if event.event == "block_done" and event.data["kind"] == "flat":
            stop.stop()

    live = script(idle, ready="")
    ran = Ran(tmp_path, FakeInstrument(), stop=stop, live=live, heard=stop_after_flats)
    assert type(ran.error) is ScanStopped and "Stopped after 0 of 12 projections" in str(ran.error)


@pytest.mark.parametrize(
    ("live", "says"),
    others_slow(
        [
            (script("import sys; sys.exit('out of memory')"), "ended with code 1"),
            (script("pass"), "ended with code 0"),
            (
                script("""print('{"event": "failed", "message": "no axis", "exit_code": 5}'); raise SystemExit(5)"""),
                "no axis",
            ),
            (lambda scan, output: [str(output / "no such program")], "could not be started"),
        ]
    ),
)
def test_a_live_reconstruction_that_dies_touches_nothing(
    tmp_path: Path, live: Callable[[Path, Path], Sequence[str]], says: str
) -> None:
    ran = Ran(tmp_path, FakeInstrument(), live=live)
    assert ran.result.recon is None
    assert any(says in text for text in ran.warnings)
    ran.assert_good_file(19, "complete")
    if says.endswith("1"):
        assert "out of memory" in (ran.folder / "recon.log").read_text(encoding="utf-8")


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
@pytest.mark.parametrize("times", others_slow([9, 1]))
def test_one_that_is_killed_in_the_scan_is_started_again_but_not_for_ever(tmp_path: Path, times: int) -> None:
    code = f"""
import json, os, pathlib, signal, sys
starts = pathlib.Path(sys.argv[1]).with_name("starts")
starts.write_text(starts.read_text() + "+" if starts.exists() else "+")
if len(starts.read_text()) <= {times}:
    os.kill(os.getpid(), signal.SIGKILL)
pathlib.Path(sys.argv[2]).write_text("volume")
print(json.dumps({{"event": "done", "time": 2.0, "output": sys.argv[2], "axis_col": 80.5}}))
"""

    def wait() -> None:
        wait_until(
            lambda: (
                "recon_done" in said or any("is started" not in text for text in said if "reconstruction ended" in text)
            )
        )

    said: list[str] = []
    instrument = FakeInstrument(at={10: wait})
    result = run_scan(
        small(), tmp_path, [lambda event: said.append(str(event.data.get("message", event.event)))],
        live=script(code), instrument=instrument.connected(),
    )  # fmt: skip
    (folder,) = tmp_path.iterdir()
    assert (folder / "starts").read_text() == "+" * min(times + 1, 3)
    assert sum("A new live reconstruction is started" in text for text in said) == min(times, 2)
    assert (result.recon is not None) == (times == 1)


def test_an_abort_ends_the_live_reconstruction(tmp_path: Path) -> None:
    stop = StopRequest()
    ran = Ran(
        tmp_path,
        FakeInstrument(at={10: stop.abort}),
        stop=stop,
        live=script("import time; time.sleep(100)"),
    )
    assert type(ran.error) is ScanAborted
    assert any("it was stopped" in text for text in ran.warnings)


def test_a_defect_of_the_run_leaves_no_live_reconstruction_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[ChildProcess] = []

    class Kept(LiveReconstruction):
        def __init__(self, *args: Any, **more: Any) -> None:
            super().__init__(*args, **more)
            assert self._process is not None
            started.append(self._process)

    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("defect")

    monkeypatch.setattr(module, "LiveReconstruction", Kept)
    monkeypatch.setattr(module, "Recorder", broken)
    ran = Ran(tmp_path, FakeInstrument(), live=script("import time; time.sleep(100)"))
    assert isinstance(ran.error, ZeroDivisionError)
    assert [process.running for process in started] == [False]


def test_a_stop_after_the_scan_ends_only_the_live_reconstruction(tmp_path: Path) -> None:
    stop = StopRequest()
    instrument = FakeInstrument()
    events: list[Event] = []

    def sink(event: Event) -> None:
        events.append(event)
        if event.event == "scan_done":
            stop.stop()

    result = run_scan(
        small(),
        tmp_path,
        [sink],
        stop,
        live=script("import time; time.sleep(100)"),
        instrument=instrument.connected(),
    )
    assert result.n_frames == 19
    assert result.recon is None


DELIVERS = """
import json, signal, sys, time
def deliver(*_):
    print(json.dumps({"event": "done", "time": 2.0, "output": sys.argv[2]}), flush=True)
    sys.exit(4)
signal.signal(signal.SIGTERM, deliver)
print(json.dumps({"event": "progress", "time": 1.0, "stage": "kernels", "n": 1, "seconds": 1.0}), flush=True)
time.sleep(100)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows ends a process without asking it")
def test_after_a_stopped_scan_the_volume_comes_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_process, "ASK_LIVE_AFTER", 0.5)
    stop = StopRequest()
    instrument = FakeInstrument(at={10: stop.stop})
    ran = Ran(tmp_path, instrument, stop=stop, live=script(DELIVERS))
    assert type(ran.error) is ScanStopped
    assert [event.data["output"] for event in ran.of("recon_done")] == [str(ran.folder / "recon.h5")]


def test_the_time_to_the_volume_of_a_stopped_scan_counts_from_the_signal() -> None:
    seconds = 1e6
    stop = StopRequest(lambda: seconds)
    stop.stop()
    seconds += live_process.ASK_LIVE_AFTER - 1  # what the scan took to end
    ends = live_process.live_should_end(stop, useless=False)
    stop.stop("again, by another signal")
    assert not ends() and live_process.live_should_end(stop, useless=True)()
    seconds += 1
    assert ends()
    late = StopRequest(lambda: seconds)
    ends = live_process.live_should_end(late, useless=False)  # the scan is complete
    assert not ends() and late.seconds == 0
    late.stop()
    assert ends()


@pytest.mark.parametrize(
    ("ended_after", "most"),
    [(None, 120), (1.0, 124), (30.0, 150)],
    ids=["stopped while its volume is waited for", "ended soon after its stop", "ended late after its stop"],
)
def test_how_long_the_volume_of_a_stopped_scan_is_waited_for_is_said_at_once_and_every_5_s(
    ended_after: float | None, most: int
) -> None:
    seconds, told = 100.0, list[str]()
    stop = StopRequest(now=lambda: seconds)
    if ended_after is not None:
        stop.stop()
        seconds += ended_after
    aborting = live_process.abort_watch(stop, told.append)
    if ended_after is None:
        assert not aborting() and not told
        stop.stop()
    first, begin = round(ended_after or 0), seconds
    for after in (0.0, 1.0, 4.5, 5.0):
        seconds = begin + after
        assert not aborting()
    waiting = "Waiting for the live volume from the projections taken so far"
    assert [text.split(".")[0] for text in told] == [f"{waiting} ({first + n} of at most {most} s)" for n in (0, 5)]
    stop.abort()
    seconds += 100.0
    assert aborting() and len(told) == 2


def test_a_scan_with_enough_views_waits_for_its_volume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_process, "ASK_LIVE_AFTER", 0.0)
    fits = """
import json, sys, time
time.sleep(0.5)
print(json.dumps({"event": "done", "time": 2.0, "output": sys.argv[2]}), flush=True)
"""
    stop, words = StopRequest(), ("scan.angles={scheme: interlaced, views: 12, passes: 4}", "scan.period_s=2")
    with choosing(monkeypatch, Scripted([Choice.ENOUGH])):
        ran = Ran(tmp_path, FakeInstrument(), *words, stop=stop, live=script(fits))
    assert ran.error is None and len(ran.of("recon_done")) == 1 and ran.result.n_frames == 10
    assert not stop.stopping


def test_a_law_that_the_live_reconstruction_measures_is_passed_on(tmp_path: Path) -> None:
    program = """
import json
law = {"event": "error_law", "number": 1, "n_views": 90, "noise": 0.2, "offset": 0.0}
print(json.dumps({**law, "exponent": 1.1, "exponent_error": 0.1, "gained": None}))
print(json.dumps({"event": "error_law", "n_views": 90}))
"""
    laws: list[LawMeasured] = []
    command = script(program)(tmp_path / "scan.h5", tmp_path / "recon.h5")
    process = LiveReconstruction(command, tmp_path / "recon.log", lambda event: None, laws.append)
    process.finish(stop=lambda: False, hurry=lambda: False)
    (law,) = laws
    assert (law.n_views, law.exponent, law.noise, law.gained) == (90, 1.1, 0.2, None)


@pytest.mark.parametrize(("code", "ended"), [("raise SystemExit(1)", True), ("import time; time.sleep(100)", False)])
def test_a_live_reconstruction_that_gives_no_law_any_more_is_known(tmp_path: Path, code: str, ended: bool) -> None:
    command = script(code)(tmp_path / "scan.h5", tmp_path / "recon.h5")
    events: list[Event] = []
    process = LiveReconstruction(command, tmp_path / "recon.log", events.append)
    wait_until(lambda: len(events) == 1 + ended)
    assert process.ended is ended
    process.close()
    absent = LiveReconstruction([str(tmp_path / "no program")], tmp_path / "other.log", events.append)
    assert absent.ended


@pytest.mark.parametrize("stopped", [False, True])
def test_a_method_that_needs_the_whole_scan_has_its_volume_after_a_complete_one(tmp_path: Path, stopped: bool) -> None:
    checks = """
import h5py, json, sys
with h5py.File(sys.argv[1]) as file:
    print(json.dumps({"event": "done", "output": sys.argv[2], "frames": len(file["entry/data/data"])}))
"""
    stop, events = StopRequest(), list[Event]()
    instrument = FakeInstrument(on_frame=lambda number: stop.stop() if stopped and number == 10 else None)

    def scan() -> RunResult:
        return run_scan(
            small(),
            tmp_path,
            [events.append],
            stop,
            instrument=instrument.connected(),
            live=Commands(afterwards=script(checks)),
        )

    if stopped:
        with pytest.raises(ScanStopped):
            scan()
        assert all(event.event != "recon_done" for event in events)
    else:
        result = scan()
        assert result.recon is not None and result.recon["frames"] == 19
        names = [event.event for event in events]
        assert names.index("scan_done") < names.index("recon_done") and names[-1] == "done"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows ends a process without asking it")
@pytest.mark.parametrize("hurry", [False, True])
def test_one_that_is_ended_may_deliver_what_it_has_but_in_a_hurry_it_is_not_waited_for(
    tmp_path: Path, hurry: bool
) -> None:
    said: list[str] = []
    code = DELIVERS.replace("sys.exit(4)", "time.sleep(100)").replace('"done"', '"progress"') if hurry else DELIVERS
    command = script(code)(tmp_path / "scan.h5", tmp_path / "recon.h5")
    live = LiveReconstruction(command, tmp_path / "recon.log", lambda event: said.append(event.event))
    done = live.finish(stop=lambda: "progress" in said, hurry=lambda: hurry)
    if hurry:
        assert done is None and said[-1] == "warning"
    else:
        assert done is not None and done["output"] == str(tmp_path / "recon.h5") and "warning" not in said


@pytest.mark.parametrize("killed", [False, True])
def test_a_process_that_waits_becomes_the_command(tmp_path: Path, killed: bool) -> None:
    """One that has died meanwhile is replaced."""
    standby, lines, ended = Standby(), list[str](), threading.Event()
    standby.prepare()
    waiting = standby._process
    assert waiting is not None
    standby.prepare()
    assert standby._process is waiting
    if killed:
        waiting.end()
    log = tmp_path / "recon.log"
    words = [sys.executable, "-m", "beamline.cli.main", "recon", str(tmp_path / "no.h5"), "--json", "--beside-scan"]
    with log.open("x") as stderr:
        process = standby.start(words, stderr, lines.append, on_end=ended.set, tether=True, behind=True)
    assert (process is waiting) is not killed and standby._process is None
    assert process.wait(seconds=120) is ProcessEnd.EXITED and process.code == 5 and ended.is_set()
    assert json.loads(lines[-1])["event"] == "failed" and "no.h5" in lines[-1]
    standby.close()


def test_a_process_that_waits_ends_with_its_owner(tmp_path: Path) -> None:
    standby = Standby()
    standby.prepare()
    waiting = standby._process
    assert waiting is not None
    waiting.let_go()
    assert waiting.wait(seconds=120) is ProcessEnd.EXITED and waiting.code == 0


@pytest.mark.parametrize("shows", [True, False])
def test_a_process_that_draws_pictures_ends_with_the_scan_and_the_volume_comes_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shows: bool
) -> None:
    """It is killed when its picture shows all projections, or soon after the scan, and nobody is warned."""
    monkeypatch.setattr(live_process, "_SHOWN_WITHIN", 1.0)
    shown = """print('{"event": "state", "state": "shown", "message": ""}', flush=True)\n""" if shows else ""
    draws = f"""
import pathlib, sys, time
{shown}time.sleep(60)
"""
    after = """
import json, sys
print(json.dumps({"event": "done", "output": sys.argv[2]}))
"""
    events, how = list[Event](), Commands(script(draws), script(after), draws=True)
    begin = time.monotonic()
    result = run_scan(small(), tmp_path, [events.append], instrument=FakeInstrument().connected(), live=how)
    assert result.recon is not None and time.monotonic() - begin < 30
    names = [event.event for event in events]
    assert names.index("scan_done") < names.index("recon_done") and "warning" not in names
    assert ("shown" in [event.data.get("state") for event in events]) is shows
