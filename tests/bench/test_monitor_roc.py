"""Detection rates and false alarms of the monitor; pytest -m bench -s tests/bench/test_monitor_roc.py.

Anomalies of a stated strength in scans of samples that no limit was tuned on: recall and latency. Clean scans, each
hard in its own way: false findings. docs/monitor.md sums up what this prints.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from beamline.monitor import watch
from beamline.monitor.check import Flag, Level, ScanContext
from drivers.base.frame import FrameKind
from simulators.effects.stage.errors import Jump
from simulators.scenes.expose import Scan
from simulators.scenes.scene import Scene
from tests.bench.monitor_scenes import (
    CLEAN,
    COLS,
    PITCH,
    ROWS,
    SATURATION,
    Make,
    band,
    base_scene,
    blur,
    floater,
    gain,
    ghost,
    jump,
    lost,
    seen,
    storm,
    with_anomalies,
)

UNSEEN = 30  # number of the first sample that no limit was tuned on
EVENTS = 20  # of each kind and strength
SAMPLES = 3  # that they are spread over
SCANS = 2  # clean ones of each difficulty
LEAST_RECALL = {"gain step 1 %": 0.2, "floater turning, 6 px, 5 %, at 1.5 to 2.2 half fields": 0.8, "blur 0.7 px": 0.7,
                "blur down, 1 px": 0.8}  # fmt: skip
USUAL_RECALL = 0.9
MOST_LATENT = {"floater": 15, "ghost": 15}  # views, median; other checks flag the view itself or the next
TURNING = {"floater turning, 6 px, 5 %, at 2.2 to 4 half fields": 30,
           "floater turning, 6 px, 5 %, at 1.5 to 2.2 half fields": 56}  # fmt: skip
BEFORE, AFTER = 45, 60  # views that are played before and after the first view that shows an anomaly
WINDOW = 10  # views after the last one that shows it, up to which a flag is its flag

STRENGTHS: dict[str, tuple[str, Make]] = {  # row of the table: the check that has to find it, and how it is drawn
    "floater turning, 6 px, 5 %, at 2.2 to 4 half fields": ("floater", floater(6, 0.05, away=(2.2, 4.0))),
    "floater turning, 6 px, 5 %, at 1.5 to 2.2 half fields": ("floater", floater(6, 0.05, away=(1.5, 2.2))),
    "floater loose, 6 px, 2 %": ("floater", floater(6, 0.02, "loose")),
    "floater loose, 6 px, 5 %": ("floater", floater(6, 0.05, "loose")),
    "floater loose, 6 px, 10 %": ("floater", floater(6, 0.10, "loose")),
    "floater loose, 3 px, 10 %": ("floater", floater(3, 0.10, "loose")),
    "floater loose, 12 px, 5 %": ("floater", floater(12, 0.05, "loose")),
    "ghost 1 %": ("ghost", ghost(0.01)),
    "ghost 2 %": ("ghost", ghost(0.02)),
    "ghost 5 %": ("ghost", ghost(0.05)),
    "ghost 20 %": ("ghost", ghost(0.20)),
    "band, 1 row": ("bands", band(1, 0)),
    "band, 2 rows": ("bands", band(2, 0)),
    "band, 8 rows": ("bands", band(8, 0)),
    "band, 1 column": ("bands", band(1, 1)),
    "band, 2 columns": ("bands", band(2, 1)),
    "band, 8 columns": ("bands", band(8, 1)),
    "jump across, 0.5 px": ("motion", jump(0.5, down=False)),
    "jump across, 1 px": ("motion", jump(1.0, down=False)),
    "jump down, 0.5 px": ("motion", jump(0.5, down=True)),
    "jump down, 1 px": ("motion", jump(1.0, down=True)),
    "gain step 1 %": ("gain", gain(0.01)),
    "gain step 2 %": ("gain", gain(0.02)),
    "gain step 5 %": ("gain", gain(0.05)),
    "blur 0.7 px": ("blur", blur(0.7, 0.7)),
    "blur 1 px": ("blur", blur(1, 1)),
    "blur 2 px": ("blur", blur(2, 2)),
    "blur 3 px": ("blur", blur(3, 3)),
    "blur across, 1 px": ("blur", blur(0, 1)),
    "blur down, 1 px": ("blur", blur(1, 0)),
    "beam lost, 2 % left": ("lost", lost(0.02)),
    "zingers, 2e-4 a pixel, 1 of the light": ("zingers", storm(2e-4, 5e3)),
    "zingers, 2e-4 a pixel, 4 of the light": ("zingers", storm(2e-4, 2e4)),
    "zingers, 4e-4 a pixel, 4 of the light": ("zingers", storm(4e-4, 2e4)),
}


@dataclass(frozen=True)
class Event:
    """Rows of an anomaly in the frames that were played, and the flags of all checks.

    Attributes:
        first, last: rows that show it.
        flags: warnings and alarms.
    """

    first: int
    last: int
    flags: tuple[Flag, ...]

    def latency(self, check: str) -> int | None:
        """Views from the first one that shows it to the first flag of the check; None where there is none."""
        rows = [f.frame for f in self.flags if f.check == check and self.first <= f.frame <= self.last + WINDOW]
        return rows[0] - self.first if rows else None


_base = cache(base_scene)


def flags_of(scene: Scene, seed: int, views: Sequence[int] | None = None) -> tuple[int, tuple[Flag, ...]]:
    """Frames that were played, and warnings and alarms, each with the row at which it was raised as its frame."""
    monitor, flags, n = watch.start(ScanContext(SATURATION, ROWS * COLS, 0.1)), list[Flag](), 0
    for frame in seen(scene, seed, views=views):
        monitor, found = watch.look(monitor, frame.frame, frame.digest)
        flags += [replace(flag, frame=frame.frame.index) for flag in found if flag.level is not Level.INFO]
        n += 1
    return n, tuple(flags)


def anomalous_event(name: str, number: int) -> Event:
    _, make = STRENGTHS[name]
    base = _base("battery", UNSEEN + number % SAMPLES)
    rng = np.random.default_rng([UNSEEN, number, *name.encode()])
    shots = [planned.shot for planned in Scan.of(base, 0) if planned.kind is FrameKind.PROJECTION]
    while True:
        anomaly = make(rng, len(shots))
        shows = [shot.view for shot in shots if anomaly.labels(shot)]
        if shows and BEFORE <= shows[0] < len(shots) - AFTER:
            break
    views = range(shows[0] - BEFORE, shows[0] + AFTER)
    _, flags = flags_of(with_anomalies(base, [anomaly]), 9000 + number, views)
    references = len(Scan.of(base, 0)) - len(shots)
    first = references + BEFORE
    return Event(first, first + min(shows[-1], views[-1]) - shows[0], flags)


def _others(check: str, events: Sequence[Event]) -> str:
    """Other checks that flagged something, with the number of scans."""
    found = Counter(name for event in events for name in {flag.check for flag in event.flags} if name != check)
    return ", ".join(f"{name} {n}" for name, n in found.most_common()) or "-"


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", STRENGTHS)
def test_recall_and_latency(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    check = STRENGTHS[name][0]
    events = [anomalous_event(name, number) for number in range(EVENTS)]
    late = [latency for event in events if (latency := event.latency(check)) is not None]
    early = Counter(flag.check for event in events for flag in event.flags if flag.frame < event.first)
    middle, most = (f"{np.percentile(late, q):.0f}" if late else "-" for q in (50, 95))
    with capsys.disabled():
        recall, others = len(late) / EVENTS, _others(check, events)
        print(f"\n| {name} | {check} | {recall:.2f} | {middle} | {most} | {others} | {dict(early) or '-'} |")
    assert recall >= LEAST_RECALL.get(name, USUAL_RECALL)
    assert np.median(late) <= TURNING.get(name, MOST_LATENT.get(check, 1))


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("pixels", [0.0, 0.5, 0.7, 1.0])
@pytest.mark.parametrize("name", ["battery", "sparse", "faces", "interior", "starved"])
def test_a_sample_that_sank_against_its_view_from_the_other_side(
    name: str, pixels: float, capsys: pytest.CaptureFixture[str]
) -> None:
    found, most, n = 0, 0.0, 4
    for number in range(n):
        base = _base(name, UNSEEN + number)
        views = sum(planned.kind is FrameKind.PROJECTION for planned in Scan.of(base, 0))
        scene = with_anomalies(base, [Jump(views // 2, (0.0, 0.0, pixels * PITCH))] if pixels else [])
        _, flags = flags_of(scene, 7000 + number, [*range(8), *range(views - 8, views)])
        scores = [flag.score for flag in flags if flag.check == "opposite"]
        found, most = found + bool(scores), max([most, *scores])
    with capsys.disabled():
        print(f"\n| {name}, down by {pixels:g} px | opposite | {found} of {n} | {most:.2f} px |")
    assert found == 0 if pixels == 0 else found >= 3 or name == "starved"


@pytest.mark.bench
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", CLEAN)
def test_false_findings_on_clean_scans(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    played = [flags_of(base_scene(name, UNSEEN + n), 8000 + n) for n in range(SCANS)]
    frames, flags = sum(n for n, _ in played), [flag for _, found in played for flag in found]
    kinds = Counter(flag.check for flag in flags)
    with capsys.disabled():
        said = ", ".join(f"{check} {n}" for check, n in kinds.items()) or "none"
        print(f"\n| {name} | {frames} | {said} |")
    assert not kinds
