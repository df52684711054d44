"""An EPICS client follows a run and the next one, and can end a run if this is allowed."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from beamline.core.errors import ConfigError
from beamline.features.epics.ioc import RunServer
from tests.beamline.features.run_folder import FAILED, STARTED, asking, write_run
from tests.beamline.pass_options import UNKNOWN, option
from tests.beamline.scans import TwoCylinders, frames_of
from tests.messages import refused

thread = pytest.importorskip("p4p.client.thread")
WITHIN = 60.0  # s


@contextmanager
def _served(runs: Path, *, control: bool = False) -> Iterator[tuple[RunServer, Any]]:
    """The server, and a client that finds it by its port alone."""
    with closing(RunServer(runs, "T:", "127.0.0.1", control, lambda line: None)) as server:
        port = server.configuration["EPICS_PVAS_SERVER_PORT"]
        conf = {"EPICS_PVA_NAME_SERVERS": f"127.0.0.1:{port}", "EPICS_PVA_AUTO_ADDR_LIST": "NO"}
        with closing(thread.Context("pva", conf=conf, useenv=False)) as client:
            yield server, client


def _until(server: RunServer, met: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WITHIN
    while not met():
        assert time.monotonic() < deadline
        server.look()
        time.sleep(0.1)


def _put(server: RunServer, client: Any, name: str, value: object = True) -> None:
    """Write a value, and look as `beamline ioc` does, until the scan has obeyed."""
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(client.put, name, value, timeout=WITHIN)
        _until(server, answer.done)
    answer.result()


def test_it_listens_where_it_is_told_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """p4p adds an address of the environment to one that it is given; this one is no machine's."""
    monkeypatch.setenv("EPICS_PVAS_INTF_ADDR_LIST", "192.0.2.1")
    with _served(tmp_path) as (server, client):
        (address,) = server.configuration["EPICS_PVAS_INTF_ADDR_LIST"].split()
        assert address.partition(":")[0] == "127.0.0.1"
        assert client.get("T:ScanStatus") == "idle"


def test_without_a_run_it_is_idle_and_beats(tmp_path: Path) -> None:
    with _served(tmp_path) as (server, client):
        assert client.get("T:ScanStatus") == "idle" and client.get("T:ImagesPlanned") == -1
        server.look()
        first = int(client.get("T:Heartbeat"))
        server.look()
        assert int(client.get("T:Heartbeat")) == first + 1


def test_a_finished_run_and_the_next_one(tmp_path: Path) -> None:
    done = {"event": "state", "time": 1.0, "state": "done"}
    write_run(tmp_path / "2026-01-01T000000_a", STARTED | {"sample": "first"}, done)
    with _served(tmp_path) as (server, client):
        server.look()
        assert (client.get("T:SampleName"), client.get("T:ScanStatus")) == ("first", "done")
        assert client.get("T:ImagesSaved") == 49 and client.get("T:PercentComplete") == 50.0
        write_run(tmp_path / "2026-01-01T000001_b", STARTED | {"sample": "second"}, done)
        server.look()
        assert client.get("T:SampleName") == "second"


def test_a_client_sees_the_time_and_the_alarm_of_each_value(tmp_path: Path) -> None:
    write_run(tmp_path / "2026-01-01T000000_a", *FAILED)
    begin = time.time()
    with _served(tmp_path) as (server, client):
        server.look()
        time.sleep(0.5)
        alarm = {
            name: (value.severity, value.timestamp)
            for name in (
                "SampleName", "Alarms", "LastFlag", "ScanStatus", "Message", "ImagesSaved", "Beam", "Heartbeat",
                "Warnings", "DiskFree",
            )
            for value in [client.get(f"T:{name}")]
        }  # fmt: skip
        assert client.get("T:ScanStatus").raw.alarm.message == "the stage does not answer"
    newest = frames_of(TwoCylinders())[-1].time
    assert alarm["SampleName"] == (0, 1.7e9) and alarm["Warnings"] == (0, 1.7e9)
    assert alarm["Alarms"] == alarm["LastFlag"] == (2, 1.7e9 + 1.25)
    assert alarm["ScanStatus"] == alarm["Message"] == (2, 1.7e9 + 2.5)
    assert alarm["ImagesSaved"] == (0, pytest.approx(newest, abs=1e-6))
    assert alarm["Beam"][0] == 3
    for name in ("Beam", "Heartbeat", "DiskFree"):
        assert begin <= alarm[name][1] <= time.time()


def test_a_monitor_gets_each_frame_with_its_time(tmp_path: Path) -> None:
    """Also where the value is the one before."""
    log = write_run(tmp_path / "2026-01-01T000000_a", STARTED) / "events.jsonl"
    seen: list[float] = []
    with _served(tmp_path) as (server, client):
        server.look()
        with closing(client.monitor("T:FrameRate", lambda value: seen.append(value.timestamp))):
            for second in (1, 2, 3):
                frame = {
                    "event": "frame", "time": 1.7e9 + second, "n": second, "frames_per_s": 2.0, "mb_per_s": 1.0,
                    "eta_s": 5.0, "mean": 1.0,
                }  # fmt: skip
                with log.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(frame) + "\n")
                _until(server, lambda: (1.7e9 + second) in seen)  # noqa: B023 - called at once
    assert seen[-3:] == [1.7e9 + 1, 1.7e9 + 2, 1.7e9 + 3]


def test_without_control_there_is_no_verb(tmp_path: Path) -> None:
    with _served(tmp_path) as (_, client), pytest.raises(TimeoutError):
        client.put("T:AbortScan", True, timeout=1.0)


def test_a_verb_without_a_scan_says_why(tmp_path: Path) -> None:
    with _served(tmp_path, control=True) as (_, client):
        with refused(thread.RemoteError):
            client.put("T:StopScan", True, timeout=WITHIN)
        after = client.get("T:StopScan")
        assert (bool(after), after.severity) == (False, 2) and "contains no run" in after.raw.alarm.message


ASKED = {
    "event": "pass_ended", "time": 1.7e9 + 3, "number": 3, "n_views": 270, "recommended": "next", "wait": 30.0,
    "options": [
        option("next", 0.8, (0.6, 1.0), 90, 95.0, 0.125, 2e9), option("enough", None, UNKNOWN),
    ],
}  # fmt: skip


def test_a_client_reads_what_can_be_measured_next_and_answers(tmp_path: Path) -> None:
    run = write_run(tmp_path / "2026-01-01T000000_a", STARTED, ASKED)
    with _served(tmp_path, control=True) as (server, client):
        with refused(thread.RemoteError):
            client.put("T:Decide", "next", timeout=WITHIN)
        server.look()
        assert list(client.get("T:Options")) == ["next", "enough"] and client.get("T:Recommended") == "next"
        assert client.get("T:OptionDoses")[0] == 12.5 and client.get("T:OptionGainsLow")[0] == 0.6
        assert client.get("T:OptionGains")[1] != client.get("T:OptionGains")[1]
        with refused(thread.RemoteError):
            client.put("T:Decide", "next", timeout=WITHIN)
        with asking(run) as answers:
            with refused(thread.RemoteError):
                client.put("T:Decide", "offset", timeout=WITHIN)
            _put(server, client, "T:Decide", "enough")
            assert answers == ["enough"] and client.get("T:Decide") == ""
            with refused(thread.RemoteError):
                client.put("T:Decide", "next", timeout=WITHIN)
        assert "is not waiting for a decision" in client.get("T:Decide").raw.alarm.message


def test_a_scan_is_paused_resumed_and_stopped_by_a_client(tmp_path: Path) -> None:
    command = [
        sys.executable, "-m", "beamline.cli.main", "scan", "configs/simulated.yaml", "--no-live", "-o", str(tmp_path),
        "--set", "scan.period_s=0.2", "--set", "scan.angles.views=2000",
    ]  # fmt: skip
    with _served(tmp_path, control=True) as (server, client):
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as scan:
            assert scan.stderr is not None
            _until(server, lambda: client.get("T:ScanStatus") == "acquiring" and client.get("T:ImagesSaved") > 6)
            _until(server, lambda: client.get("T:ImagesPlanned") > 2000 and client.get("T:FrameRate") > 0)
            _put(server, client, "T:PauseScan")
            _until(server, lambda: client.get("T:ScanStatus") == "paused")
            _put(server, client, "T:ResumeScan")
            _until(server, lambda: client.get("T:ScanStatus") == "acquiring")
            rate = client.get("T:FrameRate")
            _put(server, client, "T:StopScan")
            scan.stderr.read()
            assert scan.wait(WITHIN) == 4
        _until(server, lambda: client.get("T:ScanStatus") == "stopped")
        assert rate == rate and client.get("T:FrameRate") != client.get("T:FrameRate")  # no rate when nothing moves


def test_a_library_that_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "p4p.nt", None)
    with refused(ConfigError):
        RunServer(tmp_path, "T:", "127.0.0.1", False, print)
