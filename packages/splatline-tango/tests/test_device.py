"""A Tango client reads a run, its pictures and its end, and ends it if it is allowed to."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tango

from beamline.page.followed_run import FollowedRun, RunValues, StampedValues
from beamline.scan.control import Verb
from splatline_tango.device import ATTRIBUTES, ServerPlace, device_class, device_state, push, reading
from tests.beamline.cli.small_scan import beamline
from tests.beamline.features.run_folder import FAILED, STARTED, write_run
from tests.beamline.scans import TwoCylinders, frames_of
from tests.free_ports import free_ports

WITHIN = 60.0  # s


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        ("idle", "ON"), ("preparing", "INIT"), ("flats", "RUNNING"), ("acquiring", "RUNNING"), ("paused", "STANDBY"),
        ("asking", "STANDBY"),
        ("finishing", "RUNNING"), ("done", "ON"), ("stopped", "ON"), ("aborted", "FAULT"), ("died", "FAULT"),
    ],
)  # fmt: skip
def test_states_of_the_device(state: str, expected: str) -> None:
    """An alarm of the monitor is one of the device while the scan runs."""
    values = RunValues(state=state)
    assert device_state(values).name == expected
    assert device_state(replace(values, alarms=1)).name == ("ALARM" if expected == "RUNNING" else expected)


def test_qualities() -> None:
    stamped = StampedValues(RunValues(warnings=2, alarms=1, stored=3), 100.0)
    names = {"warnings": "WARNING", "alarms": "ALARM", "planned": "INVALID", "rate": "INVALID", "stored": "VALID"}
    assert {name: reading(stamped, name)[2].name for name in names} == {n: f"ATTR_{q}" for n, q in names.items()}
    assert reading(replace(stamped, unread="the disk is gone"), "stored")[2].name == "ATTR_INVALID"


def test_a_name_that_is_none_is_refused() -> None:
    result = beamline("tango", "--device", "scan")
    assert result.exit_code == 2 and "expected DOMAIN/FAMILY/MEMBER" in result.stderr


def test_a_place_as_arguments_of_a_server() -> None:
    assert ServerPlace("0.0.0.0", 1, "a/b/c").arguments[-1] == "giop:tcp::1"
    assert ServerPlace("127.0.0.1", 1, "a/b/c", "id19").arguments[:2] == ["splatline", "id19"]
    assert "-nodb" not in ServerPlace("127.0.0.1", 1, "a/b/c", "id19").arguments


@contextmanager
def _signals_as_before() -> Iterator[None]:
    """Tango takes the signals of its process for itself."""
    try:
        yield
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.getsignal(number))


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[FollowedRun, Path, Any]]:
    """The one device of this process, which Tango allows no second server; its folder of runs is empty at first."""
    from tango.test_context import DeviceTestContext

    runs = tmp_path_factory.mktemp("runs")
    with (
        closing(FollowedRun(runs)) as run,
        _signals_as_before(),
        DeviceTestContext(device_class(run, control=True), process=False, debug=0) as device,
    ):
        yield run, runs, device


def test_a_run_as_a_client_sees_it(served: tuple[FollowedRun, Path, Any]) -> None:
    run, runs, device = served
    run.look()
    assert (device.state(), device.ScanStatus, device.SampleName) == (tango.DevState.ON, "idle", "")
    with pytest.raises(tango.DevFailed, match="contains no run"):
        device.Stop()

    write_run(runs / "2026-01-01T000000_a", *FAILED)
    run.look()
    frames = frames_of(TwoCylinders())
    expected = {
        "SampleName": ("s", 1.7e9, "VALID"), "ScanStatus": ("failed", 1.7e9 + 2.5, "VALID"),
        "Alarms": (1, 1.7e9 + 1.25, "ALARM"), "FlagNames": (("beam",), 1.7e9 + 1.25, "VALID"),
        "ImagesSaved": (49, frames[-1].time, "VALID"), "PercentComplete": (50.0, frames[-1].time, "VALID"),
        "Angle": (pytest.approx(np.degrees(frames[-1].angle)), frames[-1].time, "VALID"),
    }  # fmt: skip
    for name, (value, at, quality) in expected.items():
        read = device.read_attribute(name)
        given = tuple(read.value) if isinstance(value, tuple) else read.value
        assert (name, given, read.quality.name) == (name, value, f"ATTR_{quality}")
        assert read.time.totime() == pytest.approx(at, abs=1e-5)
    assert device.read_attribute("Beam").quality == tango.AttrQuality.ATTR_INVALID
    assert device.state() == tango.DevState.FAULT and device.status() == "failed; the stage does not answer"
    with pytest.raises(tango.DevFailed, match="no scan is running"):
        device.Abort()
    with pytest.raises(tango.DevFailed, match="cannot be chosen now"):
        device.Decide("next")


def test_characters_beyond_latin_1_do_not_end_the_server(served: tuple[FollowedRun, Path, Any]) -> None:
    """Tango's strings are Latin-1."""
    run, runs, device = served
    write_run(runs / "2027-01-01T000000_b", {**STARTED, "sample": "Ω_µm_扫描"}, {**FAILED[-1], "message": "−1 €"})
    run.look()
    assert (device.SampleName, device.status()) == ("?_µm_??", "failed; ?1 ?")
    assert reading(StampedValues(RunValues(flag_names=("θ", "°")), 1.0), "flag_names")[0] == ["?", "°"]


def test_all_values_are_pushed(tmp_path: Path) -> None:
    pushed: dict[str, Any] = {}

    class Recorder:
        def push_change_event(self, name: str, value: Any, at: float, quality: Any) -> None:
            pushed[name] = value, quality.name

    with closing(FollowedRun(tmp_path, lambda: 100.0)) as run:
        write_run(tmp_path / "2026-01-01T000000_a", *FAILED)
        push(Recorder(), run.look())
    assert pushed["SampleName"] == ("s", "ATTR_VALID") and pushed["FlagCounts"] == ([1], "ATTR_VALID")
    assert pushed["State"] == (tango.DevState.FAULT, "ATTR_VALID") and pushed["Alarms"] == (1, "ATTR_ALARM")


def test_verbs_are_commands_only_with_control(tmp_path: Path) -> None:
    with closing(FollowedRun(tmp_path)) as run:
        watching, controlling = (vars(device_class(run, control)) for control in (False, True))
    verbs = {verb.value.capitalize() for verb in Verb} | {"Decide"}
    assert not verbs & set(watching) and verbs <= set(controlling)
    assert {each.metadata["name"] for each in ATTRIBUTES} <= set(watching)


_EVENTS = """
import json, sys, time
import tango

device, stored = tango.DeviceProxy(sys.argv[1]), []
device.subscribe_event("ImagesSaved", tango.EventType.CHANGE_EVENT, lambda told: stored.append(told.attr_value.value))
while len(stored) < 3:
    time.sleep(0.1)
print(json.dumps(stored[:3]), flush=True)
"""
"""Waits for events; a process of its own, which may end as it likes."""


@pytest.mark.slow
def test_a_simulated_scan_is_paused_resumed_and_stopped_beside_a_real_server(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    command = [sys.executable, "-m", "beamline.cli.main"]
    server = [*command, "tango", str(tmp_path), "--control", "--port", str(port)]
    scan = [
        *command, "scan", "configs/simulated.yaml", "--no-live", "-o", str(tmp_path), "--set", "scan.period_s=0.2",
        "--set", "scan.angles.views=2000",
    ]  # fmt: skip

    def until(met: Callable[[], bool]) -> None:
        deadline = time.monotonic() + WITHIN
        while not met():
            assert time.monotonic() < deadline
            time.sleep(0.2)

    with subprocess.Popen(server, stdout=subprocess.DEVNULL) as serving:
        name = f"tango://127.0.0.1:{port}/splatline/scan/1#dbase=no"
        device = tango.DeviceProxy(name)

        def answers() -> bool:
            try:
                return bool(device.ping())
            except tango.DevFailed:
                return False

        until(answers)
        with subprocess.Popen(scan, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as scanning:
            until(lambda: device.ScanStatus == "acquiring" and device.ImagesSaved > 6)
            told = subprocess.run(
                [sys.executable, "-c", _EVENTS, name], stdout=subprocess.PIPE, text=True, timeout=WITHIN
            )
            stored = json.loads(told.stdout)
            assert len(stored) == 3 and stored == sorted(stored)
            assert device.state() == tango.DevState.RUNNING and device.ImagesPlanned > 2000
            device.Pause()
            until(lambda: device.state() == tango.DevState.STANDBY)
            device.Resume()
            until(lambda: device.state() == tango.DevState.RUNNING)
            device.Stop()
            assert scanning.wait(WITHIN) == 4
        until(lambda: device.ScanStatus == "stopped")
        second = subprocess.run(server, capture_output=True, text=True, timeout=WITHIN)  # an ORB of its own
        assert second.returncode == 5 and "another program uses the port" in second.stderr
        serving.terminate() if sys.platform == "win32" else serving.send_signal(2)
        assert serving.wait(WITHIN) == 0
