"""If the process of a scan is killed or freezes, the stage stops and the shutter closes."""

import io
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from beamline.config.load import Config, config_folder, load, resolved_yaml
from beamline.core.files import CONFIG, WATCHDOG_LOG
from beamline.core.stop import PauseRequest, StopRequest
from beamline.instrument.simulated import WIRES
from beamline.scan import watchdog
from beamline.scan.watchdog import BETWEEN, FROZEN, inhibited, until_dead, watched
from drivers.base.clock import Clock, SystemClock
from drivers.epics.channel import PvValue
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.epics.wire import MotorRecord
from tests.beamline.ball_scan import COMMON
from tests.clock import wait_until
from tests.drivers.soft_ioc import PREFIX, TickingClock, record_of, serve_pva
from tests.simulators.wires.transports import serve_tcp

pytestmark = pytest.mark.usefixtures("simulated_zaber")
FREEZES = (("zaber", "scan"),) if os.name == "posix" else ()
OTHERS = (pytest.param("pi_gcs", "", marks=pytest.mark.long), ("pm16c", ""), *FREEZES)
STAGES = {"pi_gcs": "axis: A, trigger_line: 1", "zaber": "output: 1", "pm16c": "channel: 3"}
SCAN = """
import sys, time
from pathlib import Path
from beamline.config.load import load
from beamline.instrument.connect import shutter_of, stage_alone
from beamline.scan import watchdog
from beamline.scan.watchdog import watched
from drivers.base.clock import Clock, SystemClock
if len(sys.argv) > 2:
    watchdog.COMMAND = (sys.executable, "-c", sys.argv[2])
folder, by_hand = Path(sys.argv[1]), []
config = load(folder / "config.resolved.yaml", environment={})
with watched(folder, lambda event: None), stage_alone(config) as stage:
    shutter_of(config, stage, SystemClock(), by_hand.append).open()
    stage.start_move(3.0, 0.05)
    print("it turns", flush=True)
    time.sleep(100)
"""
HASTY = """
import sys
from pathlib import Path
from beamline.scan import watchdog
watchdog.FROZEN = 6.0
watchdog.main(Path(sys.argv[1]), int(sys.argv[2]), sys.stdin.buffer.raw)
"""
posix = pytest.mark.skipif(os.name != "posix", reason="a process of Windows gets no such requests")


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "frozen"), [pytest.param("zaber", "", marks=pytest.mark.long), *OTHERS])
def test_a_killed_scan_is_made_safe_and_one_that_ends_is_left_alone(
    tmp_path: Path, kind: str, frozen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SystemClock()
    line = TriggerLine(clock)
    template, outputs = config_folder() / "instrument.yaml", kind != "pm16c"
    words = [
        f"devices.shutter={'{kind: stage_output, output: 2}' if outputs else '{kind: manual}'}",
        f"devices.stage={{kind: {kind}, port: 'socket://h:1', {STAGES[kind]}, {COMMON}}}",
    ]
    controller = WIRES[kind].matching(load(template, words, {}).devices.stage.settings).controller(clock, line)
    log = tmp_path / WATCHDOG_LOG
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    speed = getattr(getattr(controller, "device", None), "axis", None)
    before = None if speed is None else dict(speed.settings)
    with serve_tcp(controller) as url:
        config = load(template, [*words, f"devices.stage.port={url}"], {})
        (tmp_path / CONFIG).write_text(resolved_yaml(config), encoding="utf-8")
        command = [sys.executable, "-c", SCAN, str(tmp_path), *([HASTY] if frozen == "scan" else [])]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as scan:
            assert scan.stdout is not None and scan.stdout.readline().strip() == b"it turns"
            time.sleep(0.2)
            assert line.angle_at(clock.now()) > 0
            assert controller.output_is_high(2) is outputs
            scan.send_signal(signal.SIGSTOP) if frozen == "scan" else scan.kill()
        wait_until(lambda: log.exists() and "disarmed" in log.read_text(encoding="utf-8"))
        text = log.read_text(encoding="utf-8")
        assert (
            "did nothing for 6 s, so it is assumed to hang"
            if frozen == "scan"
            else "The process of the scan was killed."
        ) in text
        assert "told to stop" in text
        assert ("Close the beam shutter." in text) is ("moved by hand" in text) is not outputs
        assert ("its shutter is closed" in text) is outputs
        stood = line.angle_at(clock.now())
        assert not controller.output_is_high(2)
        time.sleep(0.3)
        assert line.angle_at(clock.now()) == stood < 2.9  # it was on its way to 3
        assert "an earlier program that was killed, or lost the connection, changed" in text and not list(
            (tmp_path / "state").rglob("*.json")
        )
        assert speed is None or speed.settings == before
        log.unlink()
        told: list[str] = []
        with watched(tmp_path, lambda event: told.append(event.event)):
            pass
        assert told == [] and not log.exists()


def test_what_cannot_be_said_or_done_keeps_no_other_step_from_being_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / WATCHDOG_LOG).mkdir()  # a log that cannot be written
    (tmp_path / CONFIG).write_text(resolved_yaml(load(config_folder() / "instrument.yaml", (), {})))
    made: list[bool] = []

    def safe(config: Config, clock: Clock, say: Callable[[str], None]) -> bool:
        say("The stage was told to stop.")
        made.append(watchdog._try_until_done(lambda: 1 / 0, VirtualClock(), say, "never"))  # type: ignore[arg-type]
        return True

    monkeypatch.setattr(watchdog, "make_safe", safe)
    monkeypatch.setattr(signal, "signal", lambda *how: None)
    read, write = os.pipe()
    os.close(read)  # the scan died before its watchdog was there, and takes no answer
    monkeypatch.setattr(watchdog, "STDOUT", write)
    assert watchdog.main(tmp_path, os.getpid(), io.BytesIO(b"...")) == watchdog.ACTED
    assert made == [False]
    os.close(write)


class _Scan:
    """One that gives a sign of life a second until it freezes or ends, at times on the clock; the clock may jump."""

    def __init__(self, ends: float, jumps: dict[int, float]) -> None:
        self.clock, self._ends, self._jumps, self._looks = VirtualClock(0.0), ends, jumps, 0

    def now(self) -> float:
        return self.clock.now()

    def sleep(self, seconds: float) -> None:
        self.clock.sleep(seconds + self._jumps.pop(self._looks, 0.0))

    def signs(self, after: int | None) -> int | None:
        self._looks += 1
        return after if self.now() >= self._ends else int(min(self.now(), self._ends))


def test_a_frozen_scan_is_dead_after_so_many_seconds_and_one_that_ended_at_once() -> None:
    frozen, died = _Scan(30.0, {}), _Scan(30.0, {})
    assert until_dead(lambda: frozen.signs(30), frozen)
    assert frozen.now() == pytest.approx(30.0 + FROZEN, abs=2 * BETWEEN)
    assert not until_dead(lambda: died.signs(None), died)
    assert died.now() == pytest.approx(30.0, abs=2 * BETWEEN)


def test_a_computer_that_slept_is_no_frozen_scan() -> None:
    """Neither the scan nor the watchdog did anything meanwhile."""
    asleep = _Scan(5000.0, {9: 3600.0, 30: 500.0})
    woken: list[float] = []

    def signs() -> int | None:
        woken.append(asleep.now())
        return None if len(woken) > 300 else asleep.signs(0) if len(woken) < 60 else len(woken)

    assert not until_dead(signs, asleep)


def children_with(word: str, parent: int | None = None) -> list[psutil.Process]:
    """Those of ours, or of another process, that run and have this in their command."""
    running = [one for one in psutil.Process(parent).children() if one.status() != psutil.STATUS_ZOMBIE]
    return [one for one in running if word in " ".join(one.cmdline())]


@pytest.mark.slow
@posix
def test_requests_to_end_do_not_end_the_watchdog_of_a_scan_that_lives(tmp_path: Path) -> None:
    (tmp_path / CONFIG).write_text(resolved_yaml(load(config_folder() / "instrument.yaml", (), {})))
    told: list[str] = []
    with watched(tmp_path, lambda event: told.append(event.data["message"])):
        (process,) = children_with("beamline.scan.watchdog")
        for request in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
            process.send_signal(request)
        time.sleep(0.3)
        assert process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    assert told == [] and not (tmp_path / WATCHDOG_LOG).exists()


@pytest.mark.parametrize("paused", [False, True])
def test_a_watchdog_that_died_is_told_and_replaced_or_the_scan_pauses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, paused: bool
) -> None:
    monkeypatch.setattr(watchdog, "BEAT", 0.01)
    monkeypatch.setattr(watchdog, "COMMAND", (sys.executable, "-c", "print('ready', flush=True)"))
    told, stop, pause = list[str](), StopRequest(), PauseRequest()
    with watched(tmp_path, lambda event: told.append(event.data["message"]), stop, pause if paused else None):
        wait_until(lambda: any("has ended, too" in text for text in told))
    assert sum("ended (code 0)" in text and "another one is started" in text for text in told) == watchdog.AGAIN
    assert ("no watchdog is running" in pause.reason) is paused and not stop.stopping


def test_a_scan_that_was_taken_for_dead_ends_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watchdog, "BEAT", 0.01)
    monkeypatch.setattr(
        watchdog, "COMMAND", (sys.executable, "-c", f"print('ready'); raise SystemExit({watchdog.ACTED})")
    )
    told, stop = list[str](), StopRequest()
    with watched(tmp_path, lambda event: told.append(event.data["message"]), stop):
        wait_until(lambda: stop.aborting)
    assert "the watchdog stopped the stage and closed the shutter" in stop.reason and "The scan ends" in told[-1]


@posix
def test_the_system_is_asked_not_to_shut_down_where_it_can_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program, asked = tmp_path / "systemd-inhibit", tmp_path / "asked"
    program.write_text(f'#!/bin/sh\necho "$@" > {asked}.new; mv {asked}.new {asked}; cat; rm {asked}\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    with inhibited():
        wait_until(asked.exists)
        assert "--what=shutdown:sleep" in asked.read_text() and "--mode=block" in asked.read_text()
        (process,) = children_with("systemd-inhibit")
    assert not process.is_running()
    program.chmod(0o644)  # nothing that can be executed
    with inhibited():
        pass


class _Behind:
    """A soft IOC: a motor record, a shutter whose blade follows, and the stops of two other motors."""

    def __init__(self, record: MotorRecord, lost: bool) -> None:
        self._record, self.values = (
            record,
            {"open": 0.0, "close": 0.0, "blade": 1.0, "M.STOP": 0.0, "F.STOP": 0.0, "E": 8.0, "E.STOP": 0.0},
        )
        if lost:
            del self.values["blade"]

    @property
    def suffixes(self) -> list[str]:
        return [*self._record.suffixes, *self.values]

    def read(self, suffix: str) -> PvValue:
        return PvValue(self.values[suffix], "", 0) if suffix in self.values else self._record.read(suffix)

    def write(self, suffix: str, value: float | str) -> None:
        if suffix not in self.values:
            self._record.write(suffix, value)
        elif suffix.endswith(".STOP"):
            self.values[suffix] = float(value)
        else:
            self.values["blade"] = float(suffix == "open")


@pytest.mark.parametrize("lost", [False, True])
def test_devices_behind_process_variables_are_made_safe(monkeypatch: pytest.MonkeyPatch, lost: bool) -> None:
    """A shutter whose status is lost leaves the other steps to be done."""
    pytest.importorskip("p4p")
    monkeypatch.setattr(watchdog, "PATIENCE", 1.0)
    motor = f"{COMMON}, timeout_s: 0.5, port: 'pva://{PREFIX}"
    words = [
        f"devices.stage={{kind: epics, {motor}'}}",
        f"devices.shutter={{kind: epics, open_pv: 'pva://{PREFIX}open', close_pv: 'pva://{PREFIX}close', "
        f"status_pv: 'pva://{PREFIX}blade', timeout_s: 0.5}}",
        f"devices.sample_mover={{kind: stage, in_deg: 0, out_deg: 10, stage: {{kind: epics, {motor}M'}}}}",
        f"devices.filter={{kind: stage, places: {{none: 0}}, stage: {{kind: epics, {motor}F'}}}}",
        f"devices.monochromator={{kind: epics, pv: 'pva://{PREFIX}E', status_pv: 'pva://{PREFIX}E', "
        f"stop_pv: 'pva://{PREFIX}E.STOP', timeout_s: 0.5}}",
        "scan.mode=step",
    ]
    config = load(config_folder() / "instrument.yaml", words, {})
    clock, said = TickingClock(), list[str]()
    served = _Behind(record_of(clock, TriggerLine(clock)), lost)
    with serve_pva(served, clock, monkeypatch):
        stage = config.devices.stage.connect(clock)
        stage.start_move(3.0, 0.5)
        clock.sleep(1)
        assert stage.moving()
        assert watchdog.make_safe(config, clock, said.append) is not lost
        clock.sleep(5)
        assert not stage.moving()
        assert stage.position() < 2.9  # it was on its way to 3
        stage.close()
    assert (served.values.get("blade", 0.0), served.values["M.STOP"], served.values["F.STOP"]) == (0.0, 1.0, 1.0)
    stopped, shutter, mover, changer, crystal, left, disarmed = said
    assert re.match(
        r"stage: an earlier program that was killed, or lost the connection, changed \.VELO 28\.6\d+ for 1\.0", left
    )
    assert (crystal, served.values["E.STOP"]) == ("The monochromator was told to stop.", 1.0)
    assert changer == "The filter was told to stop."
    assert (stopped, mover) == ("The stage was told to stop.", "The sample mover was told to stop.")
    assert (shutter == "The shutter is closed.") is not lost
    assert ("DANGER" in shutter) is lost
    assert disarmed == "The stage is stopped, its trigger output is disarmed, the shutter is closed in a separate step."
