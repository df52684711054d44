"""`beamline doctor`: a table or events, exit code 1 for a failed check, and nothing left behind, also after Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import Result

from beamline.config import load as config
from beamline.features.doctor import examine as disk
from tests.beamline.cli.small_scan import beamline

FOLDER = config.config_folder()
INSTRUMENT, DEMO = str(FOLDER / "instrument.yaml"), str(FOLDER / "demo.yaml")
REPOSITORY = Path(__file__).parents[3]


@pytest.fixture(autouse=True)
def briefly(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In a folder of its own, with the disk measured by as few bytes as tell something."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(disk, "MOST", disk.LEAST)


def run(*arguments: str) -> Result:
    return beamline("doctor", *arguments)


def events(result: Result) -> list[dict[str, object]]:
    return [json.loads(line) for line in result.stdout.splitlines()]


def test_a_simulated_instrument_has_only_a_computer(tmp_path: Path) -> None:
    result = run(DEMO, "--json")
    assert result.exit_code == 0, result.stdout
    *checks, done = events(result)
    verdicts = {check["name"]: check["verdict"] for check in checks}
    assert verdicts == {
        "camera link": "not applicable",
        "camera library": "not applicable",
        "stage port": "not applicable",
        "disk space": "ok",
        "file locks": "ok",
        "disk speed": "ok",
        "memory": "ok",
    }
    assert (done["event"], done["ok"], done["failed"], done["not_applicable"]) == ("done", 4, 0, 3)
    speed = next(check for check in checks if check["name"] == "disk speed")
    # demo.yaml: frames of 144 x 160 with previews of 36 x 40, of which flats and darks come fastest
    per_frame, fastest = 144 * 160 * 2 + 36 * 40 * 4, 0.037 + (72 + 5) * 7.2e-6
    assert speed["values"]["needed_bytes_per_s"] == pytest.approx(per_frame / fastest, rel=1e-3)  # type: ignore[index]
    assert list(tmp_path.iterdir()) == []


def test_the_instrument_s_configuration_away_from_the_instrument(tmp_path: Path) -> None:
    absent = ("--set", f"devices.camera.library={tmp_path}/none.so", "--set", "devices.stage.port=COM_NONE")
    result = run(INSTRUMENT, *absent)
    assert result.exit_code == 1
    text = " ".join(result.stdout.split())  # without the table's line breaks, which depend on the folder's length
    for part in ("camera library", "failed", "There is no port COM_NONE", "cannot be loaded"):
        assert part in text, result.stdout
    found = {check["name"]: check for check in events(run(INSTRUMENT, "--json", *absent))[:-1]}
    # 2048 x 2048 frames of 16 bit: 119 wait in 1 GB, and the ring of 1 GB holds as many
    assert found["memory"]["values"]["ring_bytes"] == 119 * 2048 * 2048 * 2  # type: ignore[index]
    assert found["stage port"]["verdict"] == "failed"
    assert list(tmp_path.iterdir()) == []


def test_without_a_configuration() -> None:
    result = run()
    assert result.exit_code == 0, (
        result.stdout
    )  # what is absent here is no failure: nobody said that it should be there
    assert "serial ports" in result.stdout and "disk speed" in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= 120


def test_a_beam_monitor_is_read(tmp_path: Path) -> None:
    page = tmp_path / "ring.txt"
    page.write_text("199.4 mA", encoding="utf-8")
    chosen = f"devices.beam_monitor={{kind: ring_current, url: '{page.as_uri()}', pattern: '(.+) mA'}}"
    assert "199.4 mA" in run(DEMO, "--set", chosen).stdout
    page.write_text("down mA", encoding="utf-8")
    result = run(DEMO, "--set", chosen)
    assert result.exit_code == 1
    assert "The answer holds no number. It answered 'down mA'" in result.stdout


def test_usage_and_configuration_faults() -> None:
    assert run("--set", "scan.period_s=1").exit_code == 2
    result = run(DEMO, "--json", "--set", "scan.period_s=no")
    assert (result.exit_code, events(result)[-1]["event"]) == (2, "failed")


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_doctor_that_is_sent_away_leaves_nothing(tmp_path: Path, number: signal.Signals) -> None:
    command = [sys.executable, "-m", "beamline.cli.main", "doctor", DEMO, "--json"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    with process:
        for line in process.stdout:
            if '"disk space"' in line:  # the disk is measured next, for seconds
                process.send_signal(number)
                break
        rest = process.stdout.read()
    assert process.returncode == 130
    assert json.loads(rest.splitlines()[-1])["event"] == "failed"
    assert list(tmp_path.iterdir()) == []
