"""`beamline scan` with a camera behind areaDetector: a complete fly scan in which the stage triggers the camera."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import h5py
import numpy as np
import pytest
from test_camera import FakeIoc

from beamline.config.load import config_folder, load
from beamline.instrument.simulated import WIRES
from drivers.base.clock import SystemClock
from drivers.base.frame import FrameKind
from simulators.devices.trigger_line import TriggerLine
from tests.beamline.ball_scan import COMMON
from tests.simulators.wires.transports import serve_tcp

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]
VIEWS, DARKS, DEGREES = 24, 3, 12
CAMERA = {
    "kind": "area_detector", "driver": "spinnaker", "line": "Line2", "sensor": "[256, 320]", "readout_s": 0.003,
    "dead_s": 0.002, "electrons_per_count": 0.5, "roi": "[32, 64, 64, 96]", "binning": 1,
}  # fmt: skip


def _forward(line: TriggerLine, ioc: FakeIoc, over: threading.Event) -> None:
    """Put the stage's pulses on the camera's trigger input, once each has come."""
    at = time.time()
    while not over.wait(0.005):
        while (pulse := line.next_after(at)) is not None and pulse.time <= time.time():
            ioc.pulse([pulse.time])
            at = pulse.time


@pytest.mark.parametrize("mode", ["fly", "step"])
def test_a_whole_scan(loopback: dict[str, str], tmp_path: Path, mode: str) -> None:
    """Each trigger gives its frame: by pulses of the stage, or by software; darks by software before."""
    clock, over = SystemClock(), threading.Event()
    line, template = TriggerLine(clock), config_folder() / "instrument.yaml"
    camera = ", ".join(f"{key}: {value}" for key, value in CAMERA.items())
    words = [
        f"devices.stage={{kind: pi_gcs, port: 'socket://h:1', axis: A, trigger_line: 1, {COMMON}}}",
        "devices.shutter={kind: stage_output, output: 2}",
        f"scan.angles={{scheme: fixed, views: {VIEWS}, start_deg: 0, span_deg: {DEGREES}}}",
        f"scan.mode={mode}", "scan.exposure_s=0.01", "scan.period_s=0.2", f"scan.darks.count={DARKS}",
        "scan.flats={count: 0, at: none}", "references.on_fault=log",
    ]  # fmt: skip
    with closing(FakeIoc("B:", "spinnaker")) as ioc:
        words.append(f"devices.camera={{prefix: 'pva://{ioc.prefix}', {camera}}}")
        controller = WIRES["pi_gcs"].matching(load(template, words, {}).devices.stage.settings).controller(clock, line)
        threading.Thread(target=_forward, args=(line, ioc, over), daemon=True).start()
        with serve_tcp(controller) as url:
            options = [part for word in [*words, f"devices.stage.port={url}"] for part in ("--set", word)]
            command = ["scan", str(template), "--no-live", "-o", str(tmp_path), *options]
            done = subprocess.run(
                [sys.executable, "-m", "beamline.cli.main", *command], capture_output=True, text=True, timeout=240
            )
        over.set()
    assert done.returncode in (0, 7), done.stderr  # 7: the monitor sees that frames are uniform
    (path,) = tmp_path.glob("*/scan.h5")
    with h5py.File(path) as file:
        log = file["entry/frame_log"]
        assert log["kind"][()].tolist() == [FrameKind.DARK] * DARKS + [FrameKind.PROJECTION] * VIEWS
        degrees = file["entry/sample/rotation_angle"][DARKS:]
        np.testing.assert_allclose(degrees, np.arange(VIEWS) * DEGREES / VIEWS, atol=0.01)
        assert file["entry/progress/missing_triggers"].shape == (0,)
        assert file["entry/progress/status"][()] == b"complete"
        counts = file["entry/instrument/detector/data"][DARKS:, 0, 0]
        assert np.diff(counts.astype(int)).tolist() == [1] * (VIEWS - 1)  # the fake's frames count from their arm
