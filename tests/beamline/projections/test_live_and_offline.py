"""What the monitor finds while a scan runs is what `beamline monitor` finds in its file, frame by frame and bit by bit:
whatever preview the file holds, however busy the computer is."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamline.core.events import Event, Warned
from beamline.monitor.check import Flag, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.watch import start, usual_step
from beamline.projections.replay import replay
from beamline.projections.replayed_frames import context_of
from beamline.scan.flagged import FlaggedFrames
from beamline.scan.recorder import Recorder
from beamline.storage.flag_legend import FrameFlags
from beamline.storage.readers.open import open_scan
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import SystemClock
from drivers.base.frame import Frame, FrameKind
from tests.beamline.fakes import FakeInstrument
from tests.slow_cases import others_slow

DARK, OPEN, BITS = 100, 3000.0, 12  # counts of a camera whose range ends at 4095
PERIOD, REFERENCES = 0.1, 3


@dataclass(frozen=True)
class Troubled:
    """A scan of balls over half a turn, in which something goes wrong every few views."""

    shape: tuple[int, int]
    views: int
    seed: int

    @property
    def angles(self) -> np.ndarray:
        return np.pi * np.arange(self.views) / self.views  # 36 views: exactly one every 5°

    @property
    def step(self) -> float:
        return usual_step(np.radians(np.degrees(self.angles)))

    def frames(self) -> list[Frame]:
        rng = np.random.default_rng(self.seed)
        kinds = [FrameKind.DARK] * REFERENCES + [FrameKind.FLAT] * REFERENCES + [FrameKind.PROJECTION] * self.views
        troubles = rng.choice(["", "gain", "jump", "band", "bright", "again"], self.views, p=[0.75] + [0.05] * 5)
        frames: list[Frame] = []
        for row, kind in enumerate(kinds):
            view = row - 2 * REFERENCES
            trouble = str(troubles[view]) if view > 12 else ""
            angle = float(self.angles[view]) if view >= 0 else np.nan
            light = 0.0 if kind is FrameKind.DARK else OPEN * (0.8 if trouble == "gain" else 1.0)
            depth = self._depth(angle, 3.0 if trouble == "jump" else 0.0) if view >= 0 else np.zeros(self.shape)
            counts = rng.poisson(DARK + light * np.exp(-depth)).clip(0, 2**BITS - 1).astype(np.uint16)
            if trouble == "band":
                counts[8:16] //= 2
            if trouble == "bright":
                counts[:4, :4] = 2**BITS - 1
            if trouble == "again":
                counts = frames[-1].counts
            trigger = view if view >= 0 else row % REFERENCES
            frames.append(Frame(counts, kind, row, trigger, row, angle, 1.8e9 + row * PERIOD, 0.05))
        return frames

    def _depth(self, angle: float, shift: float) -> np.ndarray:
        rows, cols = self.shape
        r, c, total = np.arange(rows)[:, None], np.arange(cols), np.zeros(self.shape)
        for x, y, row in ((0.0, 0.0, 0.5), (0.25, 0.1, 0.3), (-0.2, 0.2, 0.7)):
            at = (cols - 1) / 2 + shift + cols * (x * np.cos(angle) + y * np.sin(angle))
            total += 0.8 * np.exp(-(((c - at) / (0.08 * cols)) ** 2) - ((r - row * rows) / (0.2 * rows)) ** 2)
        return total

    def context(self) -> ScanContext:
        """As a scan knows it before its first frame."""
        pixels = self.shape[0] * self.shape[1]
        return ScanContext(2.0**BITS - 1, pixels, PERIOD, self.step, axis_col=(self.shape[1] - 1) / 2)

    def info(self) -> ScanInfo:
        plan = {"mode": "fly", "angles_deg": np.degrees(self.angles).tolist()}
        axis = (self.shape[1] - 1) / 2
        return ScanInfo("s", plan=json.dumps(plan), period=PERIOD, axis_col=axis, saturation=2**BITS - 1)


class Busy(NXtomoWriter):
    """A disk that takes its time now and then."""

    pauses: tuple[float, ...] = ()

    def append(self, frame: Frame, digest: FrameDigest, flags: Sequence[Flag] = ()) -> None:
        time.sleep(self.pauses[frame.index % len(self.pauses)] if self.pauses else 0.0)
        super().append(frame, digest, flags)


def record(scan: Troubled, path: Path, preview_bin: int, pauses: tuple[float, ...]) -> list[Flag]:
    """Write the scan with the monitor looking on; what it found."""
    found: list[Flag] = []
    events: list[Event] = []
    with Busy(path, scan.info(), scan.shape, clock=SystemClock(), preview_bin=preview_bin, flush_every=5) as writer:
        writer.pauses = pauses
        recorder = Recorder(
            writer, start(scan.context()), FakeInstrument().timeline(), preview_bin=preview_bin, sink=events.append,
            flagged=FlaggedFrames(events.append, found.extend),
        )  # fmt: skip
        for frame in scan.frames():
            recorder.put(frame)
            time.sleep(pauses[-frame.index % len(pauses)] if pauses else 0.0)
        recorder.finish()
    warnings = [event.message for event in events if isinstance(event, Warned)]
    assert all("is being rehearsed" in text for text in warnings)  # no check failed; a busy machine is slow
    return found


def the_same(found: list[Flag], path: Path) -> None:
    """The flags of a run, those in its file and those of the file."""
    with open_scan(path) as source:
        judged = [each.flags for each in replay(source)]
        written, again = source.table.flags, FrameFlags.of_flags(judged)
    assert list(chain.from_iterable(judged)) == found
    assert_equal(again, written)


def assert_equal(again: FrameFlags, written: FrameFlags | None) -> None:
    for name in ("bits", "scores", "regions"):
        np.testing.assert_array_equal(getattr(again, name), getattr(written, name))


@pytest.mark.parametrize("examples", others_slow([1, 6]))
def test_a_run_and_its_file_have_the_same_flags(examples: int) -> None:
    settings(max_examples=examples, deadline=None)(_same_flags)()


@given(
    preview_bin=st.sampled_from([1, 3, 4, 5, 8, 12, 16]),
    rows=st.integers(17, 40),
    cols=st.integers(40, 170),
    views=st.sampled_from([24, 36, 45, 60]),
    seed=st.integers(0, 1000),
    pauses=st.lists(st.sampled_from([0.0, 0.0, 0.002, 0.01]), max_size=7).map(tuple),
)
def _same_flags(preview_bin: int, rows: int, cols: int, views: int, seed: int, pauses: tuple[float, ...]) -> None:
    scan = Troubled((rows, cols), views, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.h5"
        found = record(scan, path, preview_bin, pauses)
        with open_scan(path) as source:
            assert repr(context_of(source)) == repr(scan.context())
        the_same(found, path)
        with h5py.File(path) as file:  # and the preview is as it was asked for
            preview = file["entry/digest/preview"]
            assert preview.attrs["bin"] == preview_bin
            assert preview.shape[1:] == (-(-rows // preview_bin), -(-cols // preview_bin))
