"""A scan that failed, was aborted or was killed is never run again by itself: neither by its queue nor by the next."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.config.load import Config, config_folder
from beamline.scan import run as run_module
from tests.beamline.fakes import FakeInstrument, Faults
from tests.beamline.ran import SMALL

SIMULATED = config_folder() / "simulated.yaml"
SETTINGS = [word for each in SMALL for word in ("--set", each)] + ["--set", "devices.stage.low_deg=-60"]


def interrupt(frame: int) -> None:
    """The first Ctrl-C, and the second one, which aborts the scan."""
    for _ in range(2 if frame == 9 else 0):
        signal.raise_signal(signal.SIGINT)


HOW: dict[str, tuple[Callable[[], FakeInstrument], list[str]]] = {
    "failed": (lambda: FakeInstrument(Faults(errors={9: 99})), ["one", "two", "three"]),
    "aborted": (lambda: FakeInstrument(on_frame=interrupt), ["one", "two"]),
}
"""How the scan `two` ends, and the scans that are started by its queue."""


def queue(folder: Path, *samples: str) -> list[str]:
    """The arguments of a queue with a scan of each sample."""
    table = folder / f"{'_'.join(samples)}.csv"
    table.write_text("\n".join(["config,sample.name", *(f"{SIMULATED},{name}" for name in samples)]), "utf-8")
    return ["scan", str(table), "--no-live", "-o", str(folder / "runs"), *SETTINGS]


def files(runs: Path) -> dict[str, str]:
    """The content of every file, by path."""
    found = sorted(path for path in runs.rglob("*") if path.is_file())
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


@pytest.mark.parametrize("how", HOW)
def test_a_scan_that_did_not_end_well_is_not_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    ending, started = HOW[how]
    begun = list[str]()

    def connect(config: Config, **rest: object) -> object:
        begun.append(config.sample.name)
        return (ending() if begun[-1] == "two" else FakeInstrument()).connected()

    monkeypatch.setattr(run_module, "connect", connect)

    def run(*samples: str) -> Result:
        begun.clear()
        return CliRunner().invoke(main, queue(tmp_path, *samples))

    done = run("one", "two", "three")
    assert done.exit_code == {"failed": 3, "aborted": 130}[how], done.output
    assert begun == started
    before = files(tmp_path / "runs")
    assert len(list((tmp_path / "runs").iterdir())) == len(started)

    assert run("four", "five").exit_code == 0
    assert begun == ["four", "five"]
    after = files(tmp_path / "runs")
    assert {path: after[path] for path in before} == before  # the run of `two` was neither continued nor changed
    assert len(list((tmp_path / "runs").iterdir())) == len(started) + 2


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_queue_that_was_killed_leaves_its_scan_alone(tmp_path: Path) -> None:
    words = queue(tmp_path, "one", "two")  # in real time
    process = subprocess.Popen([sys.executable, "-m", "beamline.cli.main", *words], stderr=subprocess.DEVNULL)
    runs = tmp_path / "runs"
    deadline = time.monotonic() + 60
    while not any(runs.glob("*_one/scan.h5")) and time.monotonic() < deadline:
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    time.sleep(3)  # for what the process may have left behind
    before = files(runs)
    assert [folder.name.rpartition("_")[2] for folder in runs.iterdir()] == ["one"]
    done = CliRunner().invoke(main, [*queue(tmp_path, "three"), "--set", "simulation.clock=virtual"])
    assert done.exit_code == 0, done.output
    after = files(runs)
    assert {path: after[path] for path in before} == before
    assert sorted(folder.name.rpartition("_")[2] for folder in runs.iterdir()) == ["one", "three"]
