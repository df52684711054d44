"""A process that ignored SIGINT from its start (background of a script, some CI) continues to ignore it."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from beamline.config.load import config_folder
from tests.beamline.cli.small_scan import SCAN
from tests.beamline.scans import write_exchange

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="a process of Windows inherits no ignored signal"),
]

WITHIN = 120.0
BEAMLINE = (sys.executable, "-m", "beamline.cli.main")
SMALL = (
    "simulation.clock=real", "scan.angles.views=2000", "scan.period_s=0.2", "scan.darks.count=2", "scan.flats.count=2",
    "scan.flats.at=start", "devices.camera.roi=[1080,1968,16,160]", "recon.live=false",
)  # fmt: skip


@contextmanager
def _in_the_background(*words: str) -> Iterator[subprocess.Popen[str]]:
    """The command as `sh -c "beamline ... &"` starts it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        process = subprocess.Popen(
            [*BEAMLINE, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8"
        )
    finally:
        signal.signal(signal.SIGINT, before)
    with process:
        yield process
        process.kill()


def _heard(process: subprocess.Popen[str], word: str, times: int = 1) -> None:
    """Return when its output has had the word so often."""
    assert process.stdout is not None and process.stderr is not None
    for line in process.stdout:
        times -= word in line
        if times <= 0:
            return
    raise AssertionError(process.stderr.read())


@pytest.mark.parametrize("way", ["SIGTERM", "stop"])
def test_a_scan_goes_on_and_ends_as_it_is_asked_otherwise(tmp_path: Path, way: str) -> None:
    words = [word for each in SMALL for word in ("--set", each)]
    simulated = str(config_folder() / "simulated.yaml")
    with _in_the_background("scan", simulated, *words, "--json", "-o", str(tmp_path)) as scan:
        _heard(scan, '"event": "frame"', times=3)
        for _ in range(2):  # the second would abort
            scan.send_signal(signal.SIGINT)
        _heard(scan, '"event": "frame"', times=10)
        if way == "SIGTERM":
            scan.terminate()
        else:
            (run,) = tmp_path.iterdir()
            subprocess.run([*BEAMLINE, "stop", str(run)], check=True, capture_output=True, timeout=WITHIN)
        _, said = scan.communicate(timeout=WITHIN)
        assert scan.returncode == 4, said
        assert "Ctrl-C was pressed" not in said


def test_a_fit_goes_on_and_its_volume_is_delivered_at_sigterm(tmp_path: Path) -> None:
    write_exchange(tmp_path / "scan.h5", SCAN)
    options = ("--gaussians", "50", "--steps", "1000000", "--no-report", "--json", "-o", str(tmp_path / "v.h5"))
    with _in_the_background("recon", str(tmp_path / "scan.h5"), "-m", "r2", *options) as fit:
        _heard(fit, '"n_gaussians"')
        fit.send_signal(signal.SIGINT)
        _heard(fit, '"n_gaussians"', times=3)
        fit.terminate()
        _, said = fit.communicate(timeout=WITHIN)
        assert fit.returncode == 4, said
    assert (tmp_path / "v.h5").is_file()


def test_a_page_stays(tmp_path: Path) -> None:
    write_exchange(tmp_path / "scan.h5", SCAN)
    with _in_the_background("view", str(tmp_path / "scan.h5"), "--port", "0") as page:
        _heard(page, "http://")
        page.send_signal(signal.SIGINT)
        time.sleep(1.0)
        assert page.poll() is None
        page.terminate()
        page.wait(WITHIN)
