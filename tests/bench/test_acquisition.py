"""Speed of taking, checking and writing frames, compared with plain writing, for each stage.

Run with  pytest -m bench -s tests/bench/test_acquisition.py --basetemp FOLDER/acquisition : FOLDER is on the disk for
scans. Stages are measured in turn, several times over, as disks and machines change their speed meanwhile: ratios are
those of stages in the same round. A stage must last for several times the frames that may wait in memory (1 GB).
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.core.machine import machine_line, peak_memory, reset_peak_memory
from beamline.core.text import size
from beamline.monitor.check import Flag, ScanContext
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import FrameDigest, digests
from beamline.monitor.watch import look, start
from beamline.plan.plan import Block, FieldPlan, Mode, Place, ScanPlan, Timeline
from beamline.scan.backlog import frames_in_memory
from beamline.scan.recorder import Recorder
from beamline.storage.disk_file import ToDisk
from beamline.storage.writers import layout
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers import orca_quest
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import TriggerTrain
from drivers.frame_memory import FrameMemory

SECONDS, ROUNDS = float(os.environ.get("ACQUISITION_SECONDS", "60")), 5
REFERENCES = 2  # darks, and as many flats
RING = 8  # different views, used in turn
FEWEST = 32  # frames of a warm-up, which compiles the kernels and tells how many the time allows, and of a stage
DARK, FLAT, ABSORPTION, RADIUS = 200, 12_000, 1.5, 0.8  # counts; line integral at the axis; share of half the width
SATURATION, BIN, FLUSH_EVERY = 65_535, 8, 16
PERIOD = 1 / 120  # s between the frames' time stamps; they come as fast as they are taken
KINDS = (FrameKind.DARK,) * REFERENCES + (FrameKind.FLAT,) * REFERENCES
Step = Callable[[Frame], tuple[FrameDigest, tuple[Flag, ...]]]


@dataclass(frozen=True)
class Load:
    """The frames to write: darks, flats, and views of a cylinder on the axis with photon noise."""

    shape: tuple[int, int]

    @cached_property
    def images(self) -> list[NDArray[np.uint16]]:
        """Frames of a kind have the same noise, shifted along the cylinder."""
        random, u = np.random.default_rng(0), np.linspace(-1, 1, self.shape[1]) / RADIUS
        light = FLAT * np.exp(-ABSORPTION * np.sqrt(np.clip(1 - u**2, 0, None)))
        images = []
        for level, n in ((0 * light, REFERENCES), (0 * light + FLAT, REFERENCES), (light, RING)):
            first = (random.poisson(level + DARK, self.shape)).astype(np.uint16)
            images += [np.roll(first, i * self.shape[0] // n, axis=0) for i in range(n)]
        return images

    @cached_property
    def digests(self) -> list[FrameDigest]:
        return [digests(image, SATURATION, BIN)[1] for image in self.images]

    @cached_property
    def memory(self) -> FrameMemory:
        """Memory of the frames, as a scan has it before its first frame."""
        memory = FrameMemory()
        memory.prepare(frames_in_memory(self.timeline(1000)), self.shape)
        return memory

    def slot(self, row: int) -> int:
        """Which of the images a row of the file shows."""
        return row if row < len(KINDS) else len(KINDS) + (row - len(KINDS)) % RING

    def frame(self, row: int, n: int) -> Frame:
        """Row `row` of a scan of n frames; its pixels are those of the ring, not a copy."""
        kind = KINDS[row] if row < len(KINDS) else FrameKind.PROJECTION
        angle = np.nan if row < len(KINDS) else np.pi * (row - len(KINDS)) / n
        return Frame(self.images[self.slot(row)], kind, row, row, row, angle, 1.8e9 + row * PERIOD, PERIOD)

    def timeline(self, n: int) -> Timeline:
        """A fly scan of n frames."""
        views, none = n - len(KINDS), np.full(REFERENCES, np.nan)
        train = (TriggerTrain(0, 1, views),), np.pi / n / PERIOD
        angles = np.pi * np.arange(views) / n
        blocks = (
            Block(FrameKind.DARK, Mode.STEP, 0, none, PERIOD, PERIOD),
            Block(FrameKind.FLAT, Mode.STEP, REFERENCES, none, PERIOD, PERIOD),
            Block(FrameKind.PROJECTION, Mode.FLY, len(KINDS), angles, PERIOD, PERIOD, *train),
        )
        frame_bytes = 2 * self.shape[0] * self.shape[1]
        total = n * (frame_bytes + self.digests[0].preview.nbytes)
        none_of_them = FieldPlan(0, Place.NONE, PERIOD)
        plan = ScanPlan(angles, Mode.FLY, PERIOD, PERIOD, 0.0, none_of_them, none_of_them, "fixed")
        return Timeline(blocks, n * PERIOD, frame_bytes, total, 1, np.pi / n, 0.0, 0.0, (), (), plan)


def _context(load: Load) -> ScanContext:
    return ScanContext(SATURATION, load.shape[0] * load.shape[1], PERIOD)


def _writer(load: Load, folder: Path) -> NXtomoWriter:
    info, clock = ScanInfo("bench"), SystemClock()
    return NXtomoWriter(folder / "scan.h5", info, load.shape, clock=clock, preview_bin=BIN, flush_every=FLUSH_EVERY)


def _lost(load: Load, path: Path, n: int) -> int:
    """Rows without the checksum of their frame, which the writer got from the digest; pixels are not read back."""
    with h5py.File(path, "r") as file:
        stored = file["/entry/digest/checksum"][: int(file[layout.COMMITTED][()])]
    expected = [load.digests[load.slot(row)].checksum for row in range(n)]
    return n - int((stored == np.array(expected[: stored.size], np.uint32)).sum())


def _raw(load: Load, folder: Path, n: int) -> int:
    with (folder / "raw").open("wb", buffering=0) as file:
        disk = ToDisk(file.fileno())
        for row in range(n):
            pixels = load.frame(row, n).counts.data.cast("B")
            while pixels:
                pixels = pixels[file.write(pixels) :]
            disk(row + 1)
        disk.finish(n)
    return 0


def _written(load: Load, folder: Path, n: int, step: Step) -> int:
    with _writer(load, folder) as writer:
        for row in range(n):
            frame = load.frame(row, n)
            writer.append(frame, *step(frame))
    return _lost(load, writer.path, n)


def _with_monitor(load: Load, folder: Path, n: int) -> int:
    monitor = start(_context(load), tuple(CHECKS))

    def step(frame: Frame) -> tuple[FrameDigest, tuple[Flag, ...]]:
        nonlocal monitor
        seen, stored = digests(frame.counts, SATURATION, BIN)
        monitor, flags = look(monitor, frame, seen)
        return stored, flags

    return _written(load, folder, n, step)


def _pipeline(load: Load, folder: Path, n: int) -> int:
    writer, monitor = _writer(load, folder), start(_context(load), tuple(CHECKS))
    recorder = Recorder(writer, monitor, load.timeline(n), preview_bin=BIN, sink=lambda event: None)
    for row in range(n):
        frame = load.frame(row, n)
        pixels = load.memory.take(load.shape)
        np.copyto(pixels, frame.counts)  # as a driver copies it out of its ring
        recorder.put(replace(frame, counts=pixels))
    recorder.finish()
    writer.close("complete")
    return _lost(load, writer.path, n)


STAGES: dict[str, Callable[[Load, Path, int], int]] = {
    "raw write": _raw,
    "writer": lambda load, folder, n: _written(
        load, folder, n, lambda frame: (load.digests[load.slot(frame.index)], ())
    ),
    "writer + digest": lambda load, folder, n: _written(
        load, folder, n, lambda frame: (digests(frame.counts, SATURATION, BIN)[1], ())
    ),
    "writer + digest + monitor": _with_monitor,
    "whole pipeline": _pipeline,
}
"""What each stage does with n frames, in a folder of its own; it returns how many are lost."""


def _measured(name: str, load: Load, folder: Path, n: int) -> tuple[float, float]:
    """Seconds and processor seconds a frame, until all are on the disk and the file is closed. None is lost."""
    own = folder / "stage"
    own.mkdir()
    cpu, began = time.process_time(), time.perf_counter()
    assert STAGES[name](load, own, n) == 0
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    shutil.rmtree(own)
    return seconds / n, cpu / n


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("shape", [orca_quest.SENSOR_SHAPE, (2048, 2048)], ids=str)
def test_rate_of_acquisition(shape: tuple[int, int], tmp_path: Path) -> None:
    load, names = Load(shape), list(STAGES)
    _ = load.memory, load.digests  # now, so that no stage's time includes this work
    reset_peak_memory()
    slowest = max(_measured(name, load, tmp_path, FEWEST)[0] for name in (*names, *names))  # the kernels are compiled
    most = shutil.disk_usage(tmp_path).free // 2 // (2 * shape[0] * shape[1])
    n = int(min(max(SECONDS / (len(names) * ROUNDS) / slowest, FEWEST), most))
    rounds: list[dict[str, tuple[float, float]]] = []
    for at in range(ROUNDS):
        turned = names[at % len(names) :] + names[: at % len(names)]
        rounds.append({name: _measured(name, load, tmp_path, n) for name in turned})
    print(f"\n{machine_line()}\n{shape[0]} x {shape[1]} pixels, {n} frames, {ROUNDS} rounds; rate over a plain write")
    median = dict[str, float]()
    for name in names:
        ms, cpu_ms = (1e3 * np.median([each[name][i] for each in rounds]) for i in range(2))
        ratios = np.array([each[names[0]][0] / each[name][0] for each in rounds])
        median[name] = float(np.median(ratios))
        spread = f"{median[name]:.2f} ({ratios.min():.2f} to {ratios.max():.2f})"
        print(f"{name:<27}{1e3 / ms:>8.1f} frames/s{ms:>9.2f} ms{cpu_ms:>9.2f} CPU ms   {spread}")
    print(f"largest memory {size(peak_memory() or 0)}")
    assert median["whole pipeline"] > 0.5  # the disk is half as fast where frames are checked and described
