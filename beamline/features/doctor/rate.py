"""Rate: passes frames of an invented scan through more and more of the acquisition, beside a plain write of bytes.

Each stage is measured in turn, several times over, because disks and machines change their speed while they are
measured: the ratios are those of stages in the same round.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.machine import peak_memory, reset_peak_memory
from beamline.core.text import size
from beamline.monitor.check import Check, Flag, ScanContext
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import FrameDigest, digests
from beamline.monitor.watch import look, start
from beamline.plan.plan import Block, Mode, Timeline
from beamline.scan.recorder import Recorder, frames_in_memory
from beamline.storage.writers import layout
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from beamline.storage.writers.to_disk import ToDisk
from drivers.base.clock import Clock
from drivers.base.frame import Frame, FrameKind
from drivers.base.protocols import TriggerTrain
from drivers.frame_memory import FrameMemory

REFERENCES = 2  # darks, and as many flats
RING = 8  # different views, used in turn
FEWEST = 32  # frames of a warm-up, which compiles the kernels and tells how many the time allows, and of a stage
DARK, FLAT, ABSORPTION, RADIUS = 200, 12_000, 1.5, 0.8  # counts; line integral at the axis; share of half the width
SATURATION = 65_535
_LONG = 1000  # frames: a longer scan has no more of them in memory
PERIOD = 1 / 120  # s between the frames' time stamps; they come as fast as they are taken


@dataclass(frozen=True)
class Load:
    """The frames to write.

    Attributes:
        shape: (rows, cols) of a frame.
        preview_bin, flush_every, checks: as of a scan.
    """

    shape: tuple[int, int]
    preview_bin: int
    flush_every: int
    checks: tuple[Check, ...] = tuple(CHECKS)

    @property
    def frame_bytes(self) -> int:
        return 2 * self.shape[0] * self.shape[1]

    @cached_property
    def images(self) -> Sequence[NDArray[np.uint16]]:
        """Frames with photon noise: REFERENCES darks, as many flats, and RING views of a cylinder on the axis.

        Frames of a kind have the same noise, shifted along the cylinder."""
        random, u = np.random.default_rng(0), np.linspace(-1, 1, self.shape[1]) / RADIUS
        light = FLAT * np.exp(-ABSORPTION * np.sqrt(np.clip(1 - u**2, 0, None)))
        images = list[NDArray[np.uint16]]()
        for level, n in ((0 * light, REFERENCES), (0 * light + FLAT, REFERENCES), (light, RING)):
            first = (random.poisson(level + DARK, self.shape)).astype(np.uint16)
            images += [np.roll(first, i * self.shape[0] // n, axis=0) for i in range(n)]
        return images

    @cached_property
    def digests(self) -> Sequence[FrameDigest]:
        """For the file."""
        return [self.digested(image)[1] for image in self.images]

    def digested(self, image: NDArray[np.uint16]) -> tuple[FrameDigest, FrameDigest]:
        """For the checks, and for the file."""
        return digests(image, SATURATION, self.preview_bin)

    def slot(self, row: int) -> int:
        """Which of the images a row of the file shows."""
        first_view = 2 * REFERENCES
        return row if row < first_view else first_view + (row - first_view) % RING

    def frame(self, row: int, n: int) -> Frame:
        """Row `row` of a scan of n frames; its pixels are those of the ring, not a copy."""
        slot = self.slot(row)
        kinds = (FrameKind.DARK, FrameKind.FLAT)
        kind = kinds[slot // REFERENCES] if slot < 2 * REFERENCES else FrameKind.PROJECTION
        angle = np.nan if kind is not FrameKind.PROJECTION else np.pi * (row - 2 * REFERENCES) / n
        return Frame(self.images[slot], kind, row, row, row, angle, 1.8e9 + row * PERIOD, PERIOD)

    @cached_property
    def memory(self) -> FrameMemory:
        """Memory of the frames, as a scan has it before its first frame."""
        memory = FrameMemory()
        memory.prepare(frames_in_memory(self.timeline(_LONG)), self.shape)
        return memory

    def prepare(self) -> None:
        """Make images, digests and memory now, so that no stage's time includes this work."""
        _ = self.memory  # it needs the timeline, which needs the digests, which need the images

    @property
    def context(self) -> ScanContext:
        return ScanContext(SATURATION, self.shape[0] * self.shape[1], PERIOD)

    def timeline(self, n: int) -> Timeline:
        """A fly scan of n frames."""
        views = n - 2 * REFERENCES
        blocks = (
            Block(FrameKind.DARK, Mode.STEP, 0, np.full(REFERENCES, np.nan), PERIOD, PERIOD),
            Block(FrameKind.FLAT, Mode.STEP, REFERENCES, np.full(REFERENCES, np.nan), PERIOD, PERIOD),
            Block(
                FrameKind.PROJECTION, Mode.FLY, 2 * REFERENCES, np.pi * np.arange(views) / n, PERIOD, PERIOD,
                (TriggerTrain(0, 1, views),), np.pi / n / PERIOD,
            ),
        )  # fmt: skip
        total = n * (self.frame_bytes + self.digests[0].preview.nbytes)
        return Timeline(blocks, n * PERIOD, self.frame_bytes, total, 1, np.pi / n, 0.0, 0.0, (), ())


@dataclass(frozen=True)
class StageRun:
    """One stage of one round."""

    stage: str
    frames: int
    # seconds: from the first frame until all are on the disk and the file is closed; cpu_seconds: of all threads
    seconds: float
    cpu_seconds: float
    lost: int  # frames that are not in the file, in their row
    peak: int | None  # bytes, the largest memory of this process


@dataclass(frozen=True)
class RateRow:
    """A stage over all rounds: medians, and its rate over that of the plain write of the same round, with the lowest
    and the highest. `lost`: of all rounds; `peak`: bytes, the largest."""

    stage: str
    frames: int
    mb_per_s: float
    frames_per_s: float
    ms: float
    cpu_ms: float
    ratio: float
    lowest: float
    highest: float
    lost: int
    peak: int | None


def _raw(load: Load, folder: Path, n: int, clock: Clock) -> int:
    path = folder / "raw"
    with path.open("wb", buffering=0) as file:
        disk = ToDisk(file.fileno())
        for row in range(n):
            pixels = load.frame(row, n).counts.data.cast("B")
            while pixels:
                pixels = pixels[file.write(pixels) :]
            disk(row + 1)
        disk.finish(n)
    return n - path.stat().st_size // load.frame_bytes


def _written(
    load: Load, folder: Path, n: int, clock: Clock, step: Callable[[Frame], tuple[FrameDigest, tuple[Flag, ...]]]
) -> int:
    with _writer(load, folder, clock) as writer:
        for row in range(n):
            frame = load.frame(row, n)
            writer.append(frame, *step(frame))
    return _lost(load, writer.path, n)


def _with_monitor(load: Load, folder: Path, n: int, clock: Clock) -> int:
    monitor = start(load.context, load.checks)

    def step(frame: Frame) -> tuple[FrameDigest, tuple[Flag, ...]]:
        nonlocal monitor
        seen, stored = load.digested(frame.counts)
        monitor, flags = look(monitor, frame, seen)
        return stored, flags

    return _written(load, folder, n, clock, step)


def _pipeline(load: Load, folder: Path, n: int, clock: Clock) -> int:
    writer = _writer(load, folder, clock)
    monitor = start(load.context, load.checks)
    recorder = Recorder(writer, monitor, load.timeline(n), preview_bin=load.preview_bin, sink=lambda event: None)
    status = "failed"
    try:
        for row in range(n):
            frame = load.frame(row, n)
            pixels = load.memory.take(load.shape)
            np.copyto(pixels, frame.counts)  # as a driver copies it out of its ring
            recorder.put(replace(frame, counts=pixels))
        recorder.finish()
        status = "complete"
    finally:
        if status == "failed":
            with suppress(DataError):  # the first one is measured, too
                recorder.finish()
        writer.close(status)
    return _lost(load, writer.path, n)


STAGES: dict[str, Callable[[Load, Path, int, Clock], int]] = {
    "raw write": _raw,
    "writer": lambda load, folder, n, clock: _written(
        load, folder, n, clock, lambda frame: (load.digests[load.slot(frame.index)], ())
    ),
    "writer + digest": lambda load, folder, n, clock: _written(
        load, folder, n, clock, lambda frame: (load.digested(frame.counts)[1], ())
    ),
    "writer + digest + monitor": _with_monitor,
    "whole pipeline": _pipeline,
}
"""What each stage of a measurement does with n frames, in a folder of its own; it returns how many are lost. The first
is what the others are compared with."""


def rates(
    load: Load, folder: Path, clock: Clock, seconds: float, rounds: int, progress: Callable[[int, int, str], None]
) -> Iterator[StageRun]:
    """Measure all stages, `rounds` times in turn, in about so many seconds; each removes its file.

    The stages of a round have the same number of frames, at most what half of the free disk holds.

    Args:
        progress: told how many of all measurements are done, and which comes next.

    Raises:
        DataError: the folder is not there or cannot be written to, or its disk has too little space.
    """
    if not folder.is_dir():
        raise DataError(f"{folder} is no folder. Name one on the disk that scans are to be written to.")
    free = shutil.disk_usage(folder).free
    most = free // 2 // (load.frame_bytes + 2 * 4 * load.frame_bytes // load.preview_bin**2)
    if most < FEWEST:
        raise DataError(
            f"{size(free)} are free on the disk of {folder}; {FEWEST} frames of {size(load.frame_bytes)} must fit "
            "into half of it. Free some, or measure smaller frames with --size. Nothing was written."
        )
    total, done, slowest = len(STAGES) * (rounds + 1), 0, 0.0
    for at in range(rounds + 1):
        share = seconds / (len(STAGES) * rounds)
        n = FEWEST if at == 0 else int(min(max(share / slowest, FEWEST), most))
        names = list(STAGES)
        for name in names[at % len(names) :] + names[: at % len(names)]:
            progress(done, total, name if at else f"{name}, to warm up")
            taken = _measure(name, load, folder, n, clock)
            done += 1
            if at:
                yield taken
            else:
                again = _measure(name, load, folder, n, clock)  # the kernels are compiled now
                slowest = max(slowest, again.seconds / n)
    progress(total, total, "")


def summary(load: Load, taken: Sequence[StageRun]) -> list[RateRow]:
    """The table: a row a stage."""
    plain, *_ = STAGES
    rounds = {name: [one for one in taken if one.stage == name] for name in STAGES}
    rows = []
    for name, runs in rounds.items():
        each = np.array([one.seconds / one.frames for one in runs])
        against = np.array([one.seconds / one.frames for one in rounds[plain]]) / each
        second = float(np.median(each))
        peaks = [one.peak for one in runs if one.peak is not None]
        rows.append(
            RateRow(
                name, runs[0].frames, load.frame_bytes / second / 1e6, 1 / second, 1e3 * second,
                1e3 * float(np.median([one.cpu_seconds / one.frames for one in runs])),
                float(np.median(against)), float(against.min()), float(against.max()),
                sum(one.lost for one in runs), max(peaks, default=None),
            )
        )  # fmt: skip
    return rows


def _measure(name: str, load: Load, folder: Path, n: int, clock: Clock) -> StageRun:
    load.prepare()
    try:
        with tempfile.TemporaryDirectory(prefix="beamline-bench-", dir=folder) as own:
            reset_peak_memory()
            cpu, began = time.process_time(), time.perf_counter()
            lost = STAGES[name](load, Path(own), n, clock)
            seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
            return StageRun(name, n, seconds, cpu, lost, peak_memory())
    except OSError as error:
        raise DataError(
            f"{folder} did not take the frames ({error.strerror or error}). What was written was removed."
        ) from error


def _writer(load: Load, folder: Path, clock: Clock) -> NXtomoWriter:
    return NXtomoWriter(
        folder / "scan.h5", ScanInfo("bench"), load.shape, clock=clock, preview_bin=load.preview_bin,
        flush_every=load.flush_every,
    )  # fmt: skip


def _lost(load: Load, path: Path, n: int) -> int:
    """Rows without the checksum of their frame, which the writer got from the digest; pixels are not read back."""
    expected = np.array([load.digests[load.slot(row)].checksum for row in range(n)], np.uint32)
    with h5py.File(path, "r") as file:
        stored = file["/entry/digest/checksum"][()]
        written = min(int(file[layout.COMMITTED][()]), stored.size, n, file[layout.DATA].shape[0])
    return n - int((stored[:written] == expected[:written]).sum())
