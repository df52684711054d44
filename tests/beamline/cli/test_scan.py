"""`beamline scan`: its output, its reaction to signals, and all exit codes."""

import json
import signal
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.config.load import config_folder
from beamline.scan import run as run_module
from beamline.storage.readers.open import open_scan
from drivers.base.errors import DeviceError
from drivers.in_beam import Ask, ManualShutter
from tests.beamline.fakes import FakeInstrument, Faults

SIMULATED = str(config_folder() / "simulated.yaml")
SMALL = {
    "scan.angles.views": 12,
    "scan.period_s": 0.5,
    "scan.exposure_s": 0.02,
    "scan.darks.count": 3,
    "scan.flats.count": 2,
    "scan.flats.at": "start",
}


def scan(*arguments: str, **overrides: Any) -> Result:
    settings = [word for key, value in {**SMALL, **overrides}.items() for word in ("--set", f"{key}={value}")]
    return CliRunner().invoke(main, ["scan", SIMULATED, "--no-live", *settings, *arguments])


def on(monkeypatch: pytest.MonkeyPatch, instrument: FakeInstrument) -> None:
    """Let the command find `instrument` where the configured devices would be."""
    monkeypatch.setattr(run_module, "connect", lambda config, clock, ask, check_stop: instrument.connected())


def press(number: int, *at: int) -> Any:
    """A signal when the frames numbered `at` are taken."""
    return lambda frame: signal.raise_signal(number) if frame in at else None


def rows(runs: Path) -> int:
    (folder,) = runs.iterdir()
    with open_scan(folder / "scan.h5") as source:
        assert source.finished
        return len(list(source.frames()))


def test_0_a_scan_prints_its_file_on_stdout_and_its_story_on_stderr(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    instrument = FakeInstrument()
    on(monkeypatch, instrument)
    result = scan("-o", str(tmp_path))
    assert result.exit_code == 0, result.output
    (folder,) = tmp_path.iterdir()
    assert result.stdout.splitlines() == [f"scan      {folder / 'scan.h5'}", "frames    17"]
    assert "12 projection frames" in result.stderr
    assert "scan: 17/17" in result.stderr
    assert rows(tmp_path) == 17
    assert instrument.log[-1] == "close"  # devices that the command opened are closed


DECIDES = {"scan.decide": "ask", "scan.mode": "step", "scan.pass_views": 5}


def test_without_a_live_reconstruction_it_says_that_nothing_is_decided(tmp_path: Path) -> None:
    said = "The scan follows its plan, because it has no live reconstruction, which scan.decide ask needs."
    assert f"{SIMULATED}: {said}" in scan("--dry-run", **DECIDES).stderr
    assert "scan.decide" not in scan("--dry-run", **DECIDES | {"scan.decide": "off"}).stderr
    table = tmp_path / "day.csv"
    table.write_text(f"config,scan.decide\n{SIMULATED},\n{SIMULATED},ask\n", encoding="utf-8")
    words = [word for key in ("scan.mode", "scan.pass_views") for word in ("--set", f"{key}={DECIDES[key]}")]
    queue = CliRunner().invoke(main, ["scan", str(table), "--no-live", "--dry-run", *words])
    assert queue.exit_code == 0 and queue.stderr.count(said) == 1


def test_a_rehearsal_says_what_the_scan_takes(tmp_path: Path) -> None:
    small = {"devices.camera.roi": "[1100,1900,32,64]", "scan.mode": "step", "scan.angles.views": 4}
    small |= {"scan.darks.count": 1, "scan.flats.count": 1}
    settings = [word for key, value in small.items() for word in ("--set", f"{key}={value}")]
    real = ["scan", str(config_folder() / "instrument.yaml"), *settings, "-o", str(tmp_path), "--no-live"]
    done = CliRunner().invoke(main, [*real, "--rehearse"])
    assert done.exit_code == 0, done.output
    planned = json.loads(CliRunner().invoke(main, [*real, "--dry-run", "--json"]).stdout)["duration"]
    assert f"At the instrument the scan takes 0:00:{round(planned):02} = {planned:.1f} s" in done.stdout


def test_2_a_dry_run_of_several_scans_states_the_faults_of_all_and_plans_the_others(tmp_path: Path) -> None:
    table = tmp_path / "day.csv"
    table.write_text(f"config,sample.name,scan.period_s\n{SIMULATED},a,\n{SIMULATED},b,0.01\nnone.yaml,c,\n", "utf-8")
    result = CliRunner().invoke(main, ["scan", str(table), "--dry-run", "-o", str(tmp_path / "runs")])
    assert result.exit_code == 2 and not (tmp_path / "runs").exists()
    assert [line.split()[:3] for line in result.stdout.splitlines()[1:4]] == [
        ["a", f"{table}:2", "yes"], ["b", f"{table}:3", "no"], ["-", f"{table}:4", "no"],
    ]  # fmt: skip
    assert f"  {table}:3: scan.period_s 0.01 is below the camera's minimum" in result.stderr
    assert "none.yaml does not exist" in result.stderr and "2 scans of 3 cannot run" in result.stderr
    as_json = CliRunner().invoke(main, ["scan", str(table), "--dry-run", "--json", "-o", str(tmp_path / "runs")])
    (line,) = as_json.stdout.splitlines()
    event = json.loads(line)
    assert (as_json.exit_code, event["event"], event["exit_code"], event["valid"]) == (2, "failed", 2, False)
    assert [scan["valid"] for scan in event["scans"]] == [True, False, False]
    assert {fault["file"] for fault in event["scans"][1]["faults"]} == {str(table), SIMULATED}
    assert event["duration"] == event["scans"][0]["duration"] == sum(event["parts"].values())
    started = CliRunner().invoke(main, ["scan", str(table), "-o", str(tmp_path / "runs")])
    assert started.exit_code == 2 and "cannot run" in started.stderr and not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_several_scans_are_taken_in_turn_and_ctrl_c_ends_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    on(monkeypatch, FakeInstrument())
    taxi = {"devices.stage.low_deg": -50}
    done = scan(SIMULATED, "-o", str(tmp_path / "both"), **taxi)
    assert done.exit_code == 0, done.output
    assert [line.split()[:2] for line in done.stdout.splitlines()] == [["battery", "complete"]] * 2
    assert len(list((tmp_path / "both").iterdir())) == 2
    on(monkeypatch, FakeInstrument(on_frame=press(signal.SIGINT, 9)))
    stopped = scan(SIMULATED, "-o", str(tmp_path / "one"), **taxi)
    assert stopped.exit_code == 4 and "not started" in stopped.stdout and rows(tmp_path / "one") >= 9
    for option, said in (("--page", "--page works only with a single scan"), ("--wait", "needs a terminal")):
        assert said in scan(SIMULATED, option, "-o", str(tmp_path / "none"), **taxi).stderr
    assert "--stop-on-failure works only with several scans" in scan("--stop-on-failure").stderr
    assert not (tmp_path / "none").exists()


def test_0_with_documents_each_is_valid_and_they_lead_to_the_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = pytest.importorskip("event_model")
    on(monkeypatch, FakeInstrument())
    told = tmp_path / "told.jsonl"
    for _ in range(2):
        assert scan("-o", str(tmp_path / "runs"), "--documents", str(told)).exit_code == 0
    found = [json.loads(line) for line in told.read_text("utf-8").splitlines()]
    for each in found:
        model.schema_validators[model.DocumentNames[each["name"]]].validate(each["doc"])
    names = [each["name"] for each in found]
    assert names.count("start") == names.count("descriptor") == names.count("stop") == 2
    assert names.count("stream_resource") == 6 and names[-1] == "stop"
    docs = [each["doc"] for each in found[names.index("stop") + 1 :]]
    start, descriptor, stop = docs[0], docs[1], docs[-1]
    assert start["sample"]["name"] == "battery" and start["num_points"] == 17
    assert stop["exit_status"] == "success" and stop["num_events"] == {"primary": 17}
    assert descriptor["data_keys"]["camera"]["shape"] == [144, 160]  # of the configuration
    for key in ("camera", "camera-angle", "camera-kind"):
        (resource,) = [doc for doc in docs if doc.get("data_key") == key]
        assert resource["run_start"] == start["uid"]
        rows = [doc["indices"] for doc in docs if doc.get("stream_resource") == resource["uid"]]
        assert [row["start"] for row in rows] == [0, *(row["stop"] for row in rows[:-1])] and rows[-1]["stop"] == 17
        assert Path(resource["uri"].removeprefix("file://localhost")).is_file()


def test_4_with_documents_a_scan_that_is_stopped_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("event_model")
    on(monkeypatch, FakeInstrument(on_frame=press(signal.SIGINT, 9)))
    told = tmp_path / "told.jsonl"
    assert scan("-o", str(tmp_path / "runs"), "--documents", str(told)).exit_code == 4
    stop = json.loads(told.read_text("utf-8").splitlines()[-1])
    assert stop["name"] == "stop" and stop["doc"]["exit_status"] == "abort"
    assert "Stopped after" in stop["doc"]["reason"]


def test_2_documents_without_the_library_name_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "event_model", None)
    result = scan("-o", str(tmp_path / "runs"), "--documents", str(tmp_path / "told.jsonl"))
    assert result.exit_code == 2 and "splatline[bluesky]" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_0_with_json_stdout_is_the_events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    on(monkeypatch, FakeInstrument())
    result = scan("-o", str(tmp_path), "--json")
    assert result.exit_code == 0
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert events[0]["event"] == "state"
    assert events[-1]["event"] == "done"
    assert events[-1]["n_frames"] == 17
    assert Path(events[-1]["path"]).is_file()


def test_0_a_dry_run_prints_the_plan_and_touches_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_module, "connect", lambda *_, **how: pytest.fail("a device was touched"))
    result = scan("--dry-run", "-o", str(tmp_path / "runs"), **{"devices.stage.low_deg": -30})
    assert result.exit_code == 0, result.output
    for word in ("projection", "taxi", "counts", "blur", "skew", "duration", "free"):
        assert word in result.stdout
    assert not (tmp_path / "runs").exists()
    as_json = scan("--dry-run", "--json", **{"devices.stage.low_deg": -30})
    (line,) = as_json.stdout.splitlines()
    assert json.loads(line)["n_frames"] == 17


@pytest.mark.parametrize("arguments", [[], ["--dry-run"]])
def test_2_a_violated_limit(tmp_path: Path, arguments: list[str]) -> None:
    result = scan("-o", str(tmp_path / "runs"), *arguments, **{"scan.period_s": 0.03})
    assert result.exit_code == 2
    assert "limit" in result.stderr
    assert "nothing was started" in result.stderr
    assert not (tmp_path / "runs").exists()
    assert ("duration" in result.stdout) is bool(arguments)


def test_3_a_device_that_does_not_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(config: object, clock: object, ask: object, check_stop: object) -> None:
        raise DeviceError("stage", "does not answer")

    monkeypatch.setattr(run_module, "connect", silent)
    result = scan("-o", str(tmp_path / "runs"), "--json")
    assert result.exit_code == 3
    assert json.loads(result.stdout.splitlines()[-1])["exit_code"] == 3
    assert not (tmp_path / "runs").exists()


NAMES = ("SIGTERM", "SIGHUP", "SIGBREAK", "SIGUSR1", "SIGUSR2", "SIGXCPU")
ENDING = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]


@pytest.mark.parametrize("number", [signal.SIGINT, *ENDING[:2]])
def test_4_the_first_signal_stops_cleanly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    before, handlers = signal.getsignal(number), set[object]()

    def press_it() -> None:
        handlers.update(signal.getsignal(each) for each in ENDING)
        signal.raise_signal(number)

    instrument = FakeInstrument(at={8: press_it})
    on(monkeypatch, instrument)
    result = scan("-o", str(tmp_path), "--json")
    assert result.exit_code == 4
    assert "Stopped after" in result.stderr
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert [e["event"] for e in events[-2:]] == ["state", "failed"]  # and not told twice
    assert 9 <= rows(tmp_path) < 17
    assert not instrument.is_open
    assert signal.getsignal(number) is before
    assert len(handlers) == 1  # those that are not tried end it alike


def test_4_a_terminal_that_nobody_reads_does_not_keep_ctrl_c_from_stopping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full, write = threading.Event(), click.echo

    def echo(text: str, **options: Any) -> None:
        if "Stopping cleanly" in text:
            full.wait(60)  # as a write into a pipe that is full
        write(text, **options)

    monkeypatch.setattr(click, "echo", echo)
    on(monkeypatch, FakeInstrument(on_frame=press(signal.SIGINT, 8)))
    result = scan("-o", str(tmp_path))
    full.set()
    assert result.exit_code == 4
    assert 9 <= rows(tmp_path) < 17


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGHUP")
@pytest.mark.parametrize("name", ["SIGHUP", "SIGINT", "SIGTERM"])
def test_a_signal_that_was_ignored_before_the_scan_stays_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """`nohup` starts a process with SIGHUP ignored, a script that starts one in the background with SIGINT."""
    number = getattr(signal, name)
    on(monkeypatch, FakeInstrument(on_frame=press(number, 8)))
    before = signal.signal(number, signal.SIG_IGN)
    try:
        assert scan("-o", str(tmp_path)).exit_code == 0
    finally:
        signal.signal(number, before)


def test_130_a_second_ctrl_c_cuts_the_references_that_a_stop_still_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    instrument = FakeInstrument(on_frame=press(signal.SIGINT, 5, 6))
    on(monkeypatch, instrument)
    at_the_end = {"scan.mode": "step", "scan.flats.at": "end", "scan.darks.at": "end"}
    result = scan("-o", str(tmp_path), **at_the_end)
    assert result.exit_code == 130
    assert rows(tmp_path) == 7  # six views and the flat that was being taken
    assert not instrument.is_open


def test_130_an_abort(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    instrument = FakeInstrument(at={8: lambda: [signal.raise_signal(signal.SIGINT) for _ in range(2)]})
    on(monkeypatch, instrument)
    result = scan("-o", str(tmp_path))
    assert result.exit_code == 130
    assert "Stopping cleanly. Press Ctrl-C again to abort." in result.stderr
    assert "Aborting." in result.stderr
    assert "abort stage" in instrument.log
    assert rows(tmp_path) == 9


def test_130_an_interrupt_before_anything_was_acquired(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    instrument = FakeInstrument()

    def connect(config: object, clock: object, ask: object, check_stop: object) -> Any:
        signal.raise_signal(signal.SIGINT)
        return instrument.connected()

    monkeypatch.setattr(run_module, "connect", connect)
    result = scan("-o", str(tmp_path / "runs"))
    assert result.exit_code == 130
    assert "before the first frame" in result.stderr
    assert not (tmp_path / "runs").exists()
    assert instrument.log == ["close"]


def test_a_shutter_moved_by_hand_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    instrument, asked = FakeInstrument(), list[str]()
    monkeypatch.setattr("beamline.instrument.connect.ask_operator", asked.append)

    def connect(config: object, clock: object, ask: Any, check_stop: object) -> Any:
        connected = instrument.connected()
        return replace(connected, devices=replace(connected.devices, shutter=ByHand(instrument, ask)))

    monkeypatch.setattr(run_module, "connect", connect)
    assert scan("-o", str(tmp_path)).exit_code == 0
    assert asked == ["Close the beam shutter.", "Open the beam shutter.", "Close the beam shutter."]


class ByHand(ManualShutter):
    """A shutter that the operator moves when asked, and the fake instrument with it."""

    def __init__(self, instrument: FakeInstrument, ask: Ask) -> None:
        def put(request: str) -> None:
            ask(request)
            instrument.is_open = request.startswith("Open")

        super().__init__(put)


def test_the_live_reconstruction_is_asked_for_as_configured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def run_scan(config: object, runs: object, sinks: object, stop: object, *, ask: Any, live: Any) -> Any:
        command = live.live or live.afterwards
        asked.append(command and list(command(Path("scan.h5"), Path("recon.h5"))))
        raise KeyboardInterrupt

    monkeypatch.setattr("beamline.scan.run.run_scan", run_scan)
    runner = CliRunner()
    overrides = ["--set", "recon.seconds=7", "--set", "optics.axis_col=80.5"]
    assert runner.invoke(main, ["scan", SIMULATED, *overrides]).exit_code == 130
    assert runner.invoke(main, ["scan", SIMULATED, "--no-live"]).exit_code == 130
    assert runner.invoke(main, ["scan", SIMULATED, "--set", "recon.live=false"]).exit_code == 130
    recon = main.get_command(click.Context(main), "recon")
    assert recon is not None
    for method in ("fbp", "auto"):
        result = runner.invoke(main, ["scan", SIMULATED, "--set", f"recon.method={method}"])
        assert f"{method} needs the complete scan" in result.stderr
        command = asked.pop()
        assert "--follow" not in command
        parsed = recon.make_context("recon", command[4:]).params
        assert (parsed["method"], parsed["axis"], parsed["output"]) == (method, None, Path("recon.h5"))
    assert asked[1:] == [None, None]
    command = asked[0]
    assert command[1:5] == ["-m", "beamline.cli.main", "recon", "scan.h5"]
    assert command[command.index("--seconds") + 1] == "7.0"
    assert command[command.index("--axis") + 1] == "80.5"
    assert {"--follow", "--json"} <= set(command)
    parsed = recon.make_context("recon", command[4:]).params  # and the command understands it
    assert (parsed["seconds"], parsed["axis"], parsed["output"]) == (7.0, 80.5, Path("recon.h5"))


def test_7_a_complete_scan_with_alarms_says_so_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    on(monkeypatch, FakeInstrument(Faults(repeats={9, 10, 11})))
    result = scan("-o", str(tmp_path))
    assert result.exit_code == 7
    assert result.stdout.splitlines()[-1].startswith("flagged   stuck 3 alarm; see ")
    assert "Scan complete: 17 frames, 3 WITH AN ALARM" in result.stderr
    treated = "With --flags use, a reconstruction does this: Of 12 projections, 3 have an alarm and are left out"
    assert treated in result.stderr
    assert "complete, but 3 of 17 frames have an alarm of the monitor: stuck 3 alarm" in result.stderr.splitlines()[-1]
    assert rows(tmp_path) == 17
    on(monkeypatch, FakeInstrument(Faults(repeats={9})))
    as_json = scan("-o", str(tmp_path / "again"), "--json")
    done = json.loads(as_json.stdout.splitlines()[-1])
    assert (as_json.exit_code, done["event"], done["alarmed_frames"]) == (7, "done", 1)
    assert done["flags"] == {"stuck": {"alarm": 1}}
