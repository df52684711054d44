"""Effect of twenty open pages on a scan: its rate, and the processor time per frame."""

from __future__ import annotations

import http.client
import json
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import h5py
import numpy as np
import psutil
import pytest

PAGES, VIEWS, SPAN, PAIRS = 20, 240, 180, 3


def _page(host: str, token: str) -> None:
    """Ask as an open page does: the feed, and after each change the newest frame, sinogram, columns and flags."""
    cookie = {"Cookie": f"splatline_look_{host.rpartition(':')[2]}={token}"}

    def asked(path: str) -> Iterator[bytes]:
        with closing(http.client.HTTPConnection(host, timeout=60)) as connection:
            connection.request("GET", f"/api/{path}", headers=cookie)
            yield from connection.getresponse()

    seen = 0
    with suppress(OSError, http.client.HTTPException):  # the scan has ended
        for line in asked("feed"):
            if line.startswith(b"data: ") and (now := json.loads(line[6:])).get("frames", 0) > seen:
                newest = f"frame/{now['frames'] - 1}?corrected=1"
                for path in (newest, f"sinogram?row=72&first={seen}", "columns", "flags"):
                    list(asked(path))
                seen = now["frames"]


def _scan(runs: Path, per_s: float, pages: int) -> tuple[float, float]:
    """Frames/s of the views, and ms of processor time a frame of the scan's process."""
    command = [
        sys.executable, "-m", "beamline.cli.main", "scan", "configs/simulated.yaml", "--page", "--no-live", "-o",
        str(runs), "--set", f"scan.period_s={1 / per_s}", "--set", "scan.exposure_s=0.02", "--set",
        f"scan.angles={{scheme: fixed, views: {VIEWS}, start_deg: 20, span_deg: {SPAN}}}",
    ]  # fmt: skip
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as scan:
        assert scan.stderr is not None
        address = re.compile(r"watch:?\s+http://(\S+)/\?token=(\S+)")
        host, token = next(found.groups() for line in scan.stderr if (found := address.search(line)))
        watching = [threading.Thread(target=_page, args=(host, token), daemon=True) for _ in range(pages)]
        for thread in watching:
            thread.start()
        threading.Thread(target=scan.stderr.read, daemon=True).start()
        process, used = psutil.Process(scan.pid), 0.0
        while scan.poll() is None:
            try:
                used = sum(process.cpu_times()[:2])
            except psutil.Error:
                break
            time.sleep(0.05)
        assert scan.wait() == 0
    with h5py.File(next(runs.iterdir()) / "scan.h5") as file:
        times = file["entry/frame_log/time"][()][file["entry/frame_log/kind"][()] == 0]
        assert len(times) == VIEWS
    return (VIEWS - 1) / float(times[-1] - times[0]), 1e3 * used / VIEWS


@pytest.mark.bench
@pytest.mark.parametrize("per_s", [10.0, 20.0])
def test_open_pages_cost_a_scan_nothing(tmp_path: Path, per_s: float) -> None:
    found = [[_scan(tmp_path / f"{pair}-{pages}", per_s, pages) for pages in (0, PAGES)] for pair in range(PAIRS)]
    (alone, watched) = np.median(np.array(found), axis=0)
    print(
        f"\n{per_s:g} frames/s asked for, load {psutil.getloadavg()[0]:.1f}: alone {alone[0]:.2f} frames/s and "
        f"{alone[1]:.1f} ms of processor time a frame, with {PAGES} pages {watched[0]:.2f} and {watched[1]:.1f}"
    )
    assert watched[0] == pytest.approx(alone[0], rel=0.02)
