"""A scan whose process is killed leaves a stage that stands and a closed shutter."""

from __future__ import annotations

import io
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from beamline.config.load import Config, config_folder, load, resolved_yaml
from beamline.scan import watchdog
from beamline.scan.run_folder import CONFIG, WATCHDOG_LOG
from beamline.scan.watchdog import watched
from drivers.clock import Clock, SystemClock
from simulators.devices.clock import VirtualClock
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.registry import WIRES
from tests.beamline.ball_scan import COMMON
from tests.simulators.wires.transports import serve_tcp

STAGES = {"pi_gcs": "axis: A, trigger_line: 1", "zaber": "output: 1", "pm16c": "channel: 3"}
SCAN = """
import sys, time
from pathlib import Path
from beamline.config.load import load
from beamline.instrument.connect import shutter_of, stage_alone
from beamline.scan.watchdog import watched
from drivers.clock import Clock, SystemClock
folder, by_hand = Path(sys.argv[1]), []
config = load(folder / "config.resolved.yaml", environment={})
with watched(folder, lambda event, data: None), stage_alone(config) as stage:
    shutter_of(config, stage, SystemClock(), by_hand.append).open()
    stage.start_move(3.0, 0.05)
    print("it turns", flush=True)
    time.sleep(100)
"""


@pytest.mark.parametrize("kind", ["zaber", *(pytest.param(k, marks=pytest.mark.slow) for k in ("pi_gcs", "pm16c"))])
def test_a_killed_scan_is_made_safe_and_one_that_ends_is_left_alone(tmp_path: Path, kind: str) -> None:
    clock = SystemClock()
    line = TriggerLine(clock)
    template, outputs = config_folder() / "instrument.yaml", kind != "pm16c"
    words = [
        f"devices.shutter={'{kind: stage_output, output: 2}' if outputs else '{kind: manual}'}",
        f"devices.stage={{kind: {kind}, port: 'socket://h:1', {STAGES[kind]}, {COMMON}}}",
    ]
    controller = WIRES[kind].matching(load(template, words, {}).devices.stage.settings).controller(clock, line)
    log = tmp_path / WATCHDOG_LOG
    with serve_tcp(controller) as url:
        config = load(template, [*words, f"devices.stage.port={url}"], {})
        (tmp_path / CONFIG).write_text(resolved_yaml(config), encoding="utf-8")
        with subprocess.Popen([sys.executable, "-c", SCAN, str(tmp_path)], stdout=subprocess.PIPE) as scan:
            assert scan.stdout is not None and scan.stdout.readline().strip() == b"it turns"
            time.sleep(0.5)
            assert line.angle_at(clock.now()) > 0
            assert controller.output_is_high(2) is outputs
            scan.kill()
        deadline, text = time.monotonic() + 60, ""
        while time.monotonic() < deadline and "disarmed" not in text:
            time.sleep(0.1)
            text = log.read_text(encoding="utf-8") if log.exists() else ""
        assert "has died" in text and "told to stop" in text and "disarmed" in text
        assert ("Close the beam shutter." in text) is ("moved by hand" in text) is not outputs
        assert ("its shutter is closed" in text) is outputs
        stood = line.angle_at(clock.now())
        assert not controller.output_is_high(2)
        time.sleep(0.3)
        assert line.angle_at(clock.now()) == stood < 2.9  # it was on its way to 3
        log.unlink()
        told: list[str] = []
        with watched(tmp_path, lambda event, data: told.append(event)):
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
        made.append(watchdog._insist(lambda: 1 / 0, VirtualClock(), say, "never"))  # type: ignore[arg-type, return-value]
        return True

    monkeypatch.setattr(watchdog, "make_safe", safe)
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    watchdog.main(tmp_path)
    assert made == [False]
