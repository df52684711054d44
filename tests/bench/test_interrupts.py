"""How long a command takes to end after Ctrl-C or SIGTERM, at many moments of its work.

Wall time says what an operator waits on this machine; the processor time between signal and end says what blocks, on a
busy machine, too. A command that computes on n processors may use n s of them in a second.
"""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from beamline.monitor.digest import digest
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame, FrameKind

pytestmark = [
    pytest.mark.bench,
    pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="processor time of another process is from /proc"),
]

LIMIT = 2.0  # s
PROGRAM = (sys.executable, "-P", "-c", "from beamline.cli.main import run; run()")
SCAN, CONE, VOLUME = "scan.h5", "cone.h5", "volume.h5"
COMMANDS = {
    "info": ("info", SCAN),
    "validate": ("validate", "--deep", SCAN),
    "monitor": ("monitor", SCAN),
    "ingest": ("ingest", SCAN, "ingested.h5"),
    "archive": ("archive", SCAN, "-o", "archived.h5"),
    "recon fbp": ("recon", SCAN, "-m", "fbp", "-o", "fbp.h5"),
    "recon auto": ("recon", SCAN, "-o", "auto.h5"),
    "recon fdk": ("recon", CONE, "-m", "fbp", "-o", "fdk.h5"),
    "recon r2": ("recon", CONE, "-m", "r2", "-o", "r2.h5"),
    "tradeoff": ("tradeoff", SCAN, "-o", "tradeoff"),
    "study": ("study", "fixed-views", SCAN, "-o", "study"),
    "export": ("export", VOLUME, "-o", "exported.tif"),
    "segment": ("segment", VOLUME, "-o", "segmented"),
}
FIRST, GROWTH, MOST = 0.5, 1.4, 40.0  # s of processor time before the first signal, each after it, and the last


@dataclass(frozen=True)
class Ended:
    """One command that was interrupted: processor time before the signal, then s and processor s to its end."""

    after: float
    seconds: float
    worked: float
    code: int
    said: str


def _worked(pid: int) -> float:
    """Processor time of a process and its children that ended, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def _interrupted(command: tuple[str, ...], folder: Path, after: float, number: signal.Signals) -> Ended | None:
    """None where the command ends before it has worked so long."""
    before = set(folder.iterdir())
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a child would ignore it as a job in the background does
    process = subprocess.Popen((*PROGRAM, *command), cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        while process.poll() is None and _worked(process.pid) < after:
            time.sleep(0.02)
        if process.poll() is not None:
            return None
        at, sent = _worked(process.pid), time.perf_counter()
        process.send_signal(number)
        worked = at
        while process.poll() is None:
            worked = max(worked, _worked_if_there(process.pid))
            if time.perf_counter() - sent > 300:
                raise AssertionError(f"{command} goes on for 300 s after {number.name} at {after} s")
            time.sleep(0.005)
        seconds = time.perf_counter() - sent
        said = process.stderr.read().decode(errors="replace") if process.stderr else ""
        return Ended(at, seconds, worked - at, process.returncode, said[-200:])
    finally:
        process.kill()
        process.communicate()
        for left in set(folder.iterdir()) - before:
            subprocess.run(("rm", "-rf", str(left)), check=True)


def _worked_if_there(pid: int) -> float:
    try:
        return _worked(pid)
    except OSError:
        return 0.0


def _moments() -> Iterator[float]:
    return itertools.takewhile(lambda at: at <= MOST, (FIRST * GROWTH**n for n in itertools.count()))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("interrupts")
    rng = np.random.default_rng(0)
    _write(made / SCAN, (128, 384), 360, np.pi, ScanInfo(sample="balls", pixel_size_mm=0.01), rng)
    cone = ScanInfo(
        sample="balls", pixel_size_mm=0.1, distance_mm=300.0, source_distance_mm=200.0, axis_col=191.5
    )  # fmt: skip
    _write(made / CONE, (384, 384), 60, 2 * np.pi, cone, rng)
    subprocess.run((*PROGRAM, "recon", SCAN, "-m", "fbp", "-o", VOLUME, "--no-report"), cwd=made, check=True)
    return made


def _write(
    path: Path, shape: tuple[int, int], views: int, turn: float, info: ScanInfo, rng: np.random.Generator
) -> None:
    """Cylinders with noise."""
    angles = turn * np.arange(views) / views
    cols = np.arange(shape[1]) - (shape[1] - 1) / 2
    with NXtomoWriter(path, info, shape, clock=SystemClock()) as writer:
        for i in range(16 + views):
            kind = FrameKind.DARK if i < 8 else FrameKind.FLAT if i < 16 else FrameKind.PROJECTION
            angle = angles[i - 16] if i >= 16 else np.nan
            matter = np.zeros(shape[1])
            for radius, away, mu in ((150, 0, 0.004), (20, 80, 0.01), (9, -60, 0.02)) if i >= 16 else ():
                half = radius**2 - (cols - away * np.cos(angle + radius)) ** 2
                matter += 2 * mu * np.sqrt(np.clip(half * shape[1] / 384, 0, None))
            mean = np.broadcast_to(100 + (i >= 8) * 20000 * np.exp(-matter), shape)
            counts = np.clip(rng.poisson(mean), 0, 65535).astype(np.uint16)
            writer.append(Frame(counts, kind, i, i, i, angle, 0.1 * i, 0.05), digest(counts, 65535, 4))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_ends_soon_after_a_signal(name: str, folder: Path) -> None:
    found: list[Ended] = []
    for after, number in zip(_moments(), itertools.cycle((signal.SIGINT, signal.SIGTERM)), strict=False):
        ended = _interrupted(COMMANDS[name], folder, after, number)
        if ended is None:
            break
        found.append(ended)
        print(f"{name}: {number.name} {ended}", flush=True)
    processors = len(os.sched_getaffinity(0))
    assert 2 not in {ended.code for ended in found}, found  # usage
    assert found, f"{name} ended before {FIRST} s of work"
    assert max(ended.worked for ended in found) <= LIMIT * processors, found
    assert not [ended for ended in found if "Traceback" in ended.said], found
