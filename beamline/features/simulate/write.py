"""Writes the simulated scan of a scene into a file like that of the instrument; lists the steps of a frame."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beamline.core.durations import seconds_left
from beamline.core.errors import ConfigError, DataError
from beamline.core.events import FrameStored, Sink, json_of
from beamline.core.files import refuse_existing
from beamline.core.text import size
from beamline.monitor.digest import digest
from beamline.plan.limits import ROOM
from beamline.report.figures import grey_window
from beamline.scenes.scene_file import SceneFile
from beamline.simulate import LabelledRun, LabelLog, labels_path, write_labels
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from drivers.base.clock import Clock
from drivers.base.frame import Frame, FrameKind
from drivers.orca_quest import BITS
from recon.base.arrays import F32
from simulators.effects.catalogue import CATALOGUE, Domain
from simulators.effects.chain import Anomaly, AnomalyLabel
from simulators.frame.shot import CannotExposeError
from simulators.scenes.expose import PlannedFrame, Scan, expose
from simulators.scenes.scene import Scene

PREVIEW_BIN = 4
REPORT_EVERY = 0.1  # s of real time between `frame` events


@dataclass(frozen=True)
class SimulatedScan:
    """The written files; `stopped` if the scan ended before its last frame."""

    path: Path
    labels: Path
    n_frames: int
    runs: tuple[LabelledRun, ...]
    seconds: float
    stopped: bool


def check_output(scan: Scan, out: Path) -> None:
    """Raise DataError if the file or its labels exist, or the disk has too little space. Nothing is written."""
    for path in (out, labels_path(out)):
        refuse_existing(path)
    rows, cols = scan.detector.shape
    preview = _preview_bin(scan.detector.shape)
    needed = len(scan) * (2 * rows * cols + 4 * (rows // preview) * (cols // preview)) * ROOM
    free = shutil.disk_usage(out.parent).free
    if needed > free:
        raise DataError(
            f"{out} needs {size(needed)} for {len(scan)} frames, but its disk has {size(free)} free. Simulate fewer or "
            "smaller frames, or use another disk. Nothing was written."
        )


def write_scan(
    scene: SceneFile, scan: Scan, out: Path, sink: Sink, clock: Clock, should_stop: Callable[[], bool]
) -> SimulatedScan:
    """Compute every frame of `scan` and write it to `out`. The labels are written next to `out`, even if the work ends
    early.

    Args:
        should_stop: function called before each frame. If it returns True, the scan ends with a valid file and labels.

    Raises:
        DataError: a file exists or cannot be written, or the disk is too small.
    """
    check_output(scan, out)
    labels = labels_path(out)
    log, start, reported = LabelLog(), time.monotonic(), -REPORT_EVERY
    n = 0
    writer = NXtomoWriter(
        out, _info(scene, scan), scan.detector.shape, clock=clock, preview_bin=_preview_bin(scan.detector.shape)
    )
    try:
        with writer:
            for planned in scan:
                if should_stop():
                    writer.close("stopped")
                    break
                log.add(n, _write(scan, planned, n, writer))
                n += 1
                now = time.monotonic() - start
                if now - reported >= REPORT_EVERY or n == len(scan):
                    reported = now
                    sink(replace(_progress(n, len(scan), now, scan.detector.shape, planned.kind), time=clock.now()))
    except BaseException:
        with suppress(DataError):  # the first error is reported
            write_labels(labels, log.runs(), n)
        raise
    runs = log.runs()
    write_labels(labels, runs, n)
    return SimulatedScan(out, labels, n, runs, time.monotonic() - start, n < len(scan))


def _write(scan: Scan, planned: PlannedFrame, row: int, writer: NXtomoWriter) -> tuple[AnomalyLabel, ...]:
    shot = planned.shot
    counts = expose(scan.scene, shot)
    angle = shot.angle if planned.kind is FrameKind.PROJECTION else math.nan
    frame = Frame(counts, planned.kind, row, shot.view, shot.frame, angle, shot.time, shot.exposure)
    writer.append(frame, digest(counts, 2**BITS - 1, _preview_bin(counts.shape)))
    return scan.scene.chain.labels(shot)


def _preview_bin(shape: tuple[int, int]) -> int:
    return min(PREVIEW_BIN, *shape)


def _progress(n: int, total: int, seconds: float, shape: tuple[int, int], kind: FrameKind) -> FrameStored:
    rate = n / seconds if seconds > 0 else 0.0
    eta = seconds_left(n, total, seconds) or 0.0
    return FrameStored(n, total, kind.name.lower(), rate, rate * 2e-6 * math.prod(shape), eta)


def _info(scene: SceneFile, scan: Scan) -> ScanInfo:
    settings, beam = scene.scene.scan, scene.scene.beam
    chain = scene.scene.chain
    shot, effects = scan.frame(0).shot, {effect.name for effect in chain.effects}
    plan = {
        "views": scan.views,
        "range_deg": settings.range_deg,
        "fly": settings.fly and chain.moves,
        "seed": scan.seed,
    }
    magnification = 1.0 if beam.sod is None or beam.sdd is None else beam.sdd / beam.sod
    return ScanInfo(
        sample=scene.path.stem,
        title=f"Simulated scan of the scene {scene.path.stem}",
        pixel_size_mm=scan.detector.pitch * magnification,
        source_distance_mm=beam.sod,
        energy_kev=beam.energy_kev,
        distance_mm=None if beam.sod is None or beam.sdd is None else beam.sdd - beam.sod,
        exposure=scene.scene.detector.exposure_s,
        period=scan.period,
        axis_col=scan.detector.axis_col,
        plan=json_of(plan),
        config=scene.text,
        saturation=2**BITS - 1,
        devices={
            "simulator": {
                "seed": scan.seed,
                "electrons_per_count": shot.conversion,
                "row_period": shot.row_period if "rolling_shutter" in effects else 0.0,
            }
        },
    )


def scan_of(scene: SceneFile, seed: int, views: int | None, start: float) -> Scan:
    """The scan of a scene, see Scan.of. The last frame is computed first, so that an impossible scene raises its error
    early.

    Raises:
        CannotExposeError: the scene cannot be exposed with its settings.
    """
    scan = Scan.of(scene.scene, seed, views, start)
    expose(scan.scene, scan.frame(len(scan) - 1).shot)
    return scan


@contextmanager
def exposure_errors(scene: str) -> Iterator[None]:
    """A context that converts a CannotExposeError to a ConfigError that names the scene."""
    try:
        yield
    except CannotExposeError as error:
        raise ConfigError(f"the simulator cannot compute frames of {scene}: {error}.") from error


def steps_of(scene: Scene) -> list[tuple[str, str, str]]:
    """The steps in which a frame of a scene is computed, in order. Each has a name, the quantity that it changes, and
    what happens."""
    effects = [(e.domain, (e.name, e.domain.words, CATALOGUE[e.name].summary)) for e in scene.chain.effects]
    return [
        ("line_integrals", "", "rays through the sample"),
        *(row for domain, row in effects if domain <= Domain.OPTICAL_DEPTH),
        ("beer_lambert", "", "photons x exp(-depth)"),
        *(row for domain, row in effects if domain > Domain.OPTICAL_DEPTH),
        ("digitise", "", "electrons to whole counts"),
    ]


def unused_effects(scene: Scene) -> list[tuple[str, str]]:
    """(name, summary) of the catalogue's effects that a scene does not name."""
    named = {effect.name for effect in scene.chain.effects}
    return [(name, row.summary) for name, row in CATALOGUE.items() if name not in named]


PICTURES = 8
_COLOURS = ("orange", "cyan", "pink", "olive", "green", "red", "purple")
MOST = 512  # pixels a side that a picture of 2 inches can resolve


def sheet(scan: Scan, marked: tuple[int, ...] = ()) -> bytes:
    """A contact sheet as PNG. Its frames are computed again, so that no file is needed.

    Args:
        marked: frames that must be included, such as frames with anomalies.
    """
    # imported here, because matplotlib takes a second to load
    from beamline.report.sheets import FlaggedFrame, contact_sheet

    numbers, shape = _chosen(scan, marked), scan.detector.shape
    step, shown, views = max(1, -(-max(shape) // MOST)), list[FlaggedFrame](), list[F32]()
    anomalies = [effect.name for effect in scan.scene.chain.effects if isinstance(effect, Anomaly)]
    for number in numbers:
        planned = scan.frame(number)
        small = expose(scan.scene, planned.shot)[::step, ::step].astype(np.float32)
        angle = ""
        if planned.kind is FrameKind.PROJECTION:
            angle = f" at {np.degrees(planned.shot.angle):.1f}°"
            views.append(small)
        labels = scan.scene.chain.labels(planned.shot)
        colours = {label.kind: _COLOURS[anomalies.index(label.kind) % len(_COLOURS)] for label in labels}
        boxes = [(label.region, f"tab:{colours[label.kind]}") for label in labels]
        kinds = [f"{kind} ({colour})" for kind, colour in colours.items()]
        shown.append(FlaggedFrame(small, shape, f"{number}: {planned.kind.name.lower()}{angle}", kinds, boxes))
    low, high = window = grey_window(views, 0.5, 99.8)
    return contact_sheet(shown, window, f"counts {low:.0f} (black) to {high:.0f} (white)")


def _chosen(scan: Scan, marked: tuple[int, ...]) -> list[int]:
    """The frames of the picture: a dark and a flat (if there are any), the marked frames, and projections spread over
    the scan."""
    settings = scan.scene.scan
    first_view = settings.darks + settings.flats
    numbers = [0] if settings.darks else []
    numbers += [settings.darks] if settings.flats else []
    numbers += list(dict.fromkeys(marked))[: PICTURES - len(numbers)]
    spread = np.linspace(first_view, len(scan) - 1, PICTURES - len(numbers)).round().astype(int)
    return sorted({*numbers, *spread.tolist()})
