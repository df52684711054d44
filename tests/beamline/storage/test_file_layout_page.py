"""docs/file_layout.md names exactly what is written."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.core.events import KINDS
from beamline.features.files.ingest import ingest
from beamline.monitor.checks import ALARM_SHIFT, CHECKS
from beamline.simulate import LabelledRun, write_labels
from beamline.storage.parts import join
from beamline.storage.writers.nxtomo import NXtomoWriter, ScanInfo
from beamline.storage.writers.recon_file import read_reconstruction, write_reconstruction
from drivers.base.frame import FrameKind
from drivers.base.protocols import BeamReading
from recon.base.volume import VolumeSeries
from tests.beamline.fakes import FakeInstrument, Faults
from tests.beamline.ran import Ran
from tests.beamline.scans import TwoCylinders, frames_of, write_exchange
from tests.beamline.storage.conftest import EPOCH, append
from tests.beamline.storage.file_layout import PAGE, names, paths, rows, unmatched
from tests.clock import SteppedClock

SCAN = TwoCylinders(shape=(4, 40), pixel_size_mm=0.5)
NOT_OF_EVERY_RUN = {
    "scan.labels.json", "recon.h5", "recon.snapshot.h5", "recon.live.png", "recon.log", "report.html", "watchdog.log",
    "control/", "scan.h5.damaged",
}  # fmt: skip
"""Of simulated scans, the live reconstruction and the watchdog, whose own tests name them; and of a scan that runs or
ends."""


@pytest.fixture
def whole_scan(tmp_path: Path) -> list[Path]:
    """A scan with all that a scan file can have but a no-data value and parts, and others that have these."""
    plan = {kind: {"count": 0, "at": "start"} for kind in ("darks", "flats")}
    info = ScanInfo(
        "s", pixel_size_mm=0.5, energy_kev=20.0, distance_mm=900.0, exposure=0.1, period=0.2, axis_col=20.7,
        source_distance_mm=1e4, devices={"stage": {"model": "m"}}, beam_unit="A", filter="Al",
        monochromator_kev=20.0, plan=json.dumps(plan), saturation=4095.0,
        offset_views=True, decides=True,
    )  # fmt: skip
    frames = frames_of(SCAN)
    frames.append(replace(frames[-1], index=len(frames), kind=FrameKind.ALIGNMENT))
    writer = NXtomoWriter(tmp_path / "scan.h5", info, SCAN.shape, clock=SteppedClock(EPOCH))
    append(writer, *frames)
    writer.close(beam=[BeamReading(1.0, "A", 1.8e9)])
    assert writer.remarks == []
    ingested = ingest(write_exchange(tmp_path / "exchange.h5", SCAN), tmp_path / "ingested.h5", no_data=0.0)
    join([writer.path, writer.path], tmp_path / "joined.h5")
    return [writer.path, ingested.path, tmp_path / "joined.h5"]


def test_scan_files(whole_scan: list[Path]) -> None:
    assert unmatched(paths(*whole_scan), names("Scan file")) == (set(), set())


def test_shapes_and_types_of_a_scan_file(whole_scan: list[Path]) -> None:
    """Types as they are written, one axis in the shape for each of the dataset."""
    with h5py.File(whole_scan[0]) as file:
        for path, said, unit, *_ in rows("Scan file"):
            item = None if "<" in path else file.get(path.strip("`"))
            if item is None or said == "link":
                continue
            kind, _, shape = said.partition(" [")
            assert len(shape.split(",")) * bool(shape) == item.ndim, path
            if re.fullmatch("[iuf][1248]", kind):
                assert item.dtype.str.lstrip("<|") == kind, path
            if unit in ("s", "mm", "keV", "degree", "deg", "bit", "pixel"):
                assert item.attrs["units"] == unit, path


def test_the_flags() -> None:
    assert rows("Flags") == [[check.name, str(check.bit), check.unit, check.meaning] for check in CHECKS]
    assert f"`{ALARM_SHIFT} + b`" in PAGE


@pytest.mark.slow
def test_volume_file_checkpoint_and_their_events(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    with NXtomoWriter(path, ScanInfo("s", pixel_size_mm=0.5), SCAN.shape, clock=SteppedClock(EPOCH)) as writer:
        append(writer, *frames_of(SCAN))
        writer.close("stopped", reason="Enough.")
    events: list[dict[str, object]] = []
    fit = ["--method", "r2", "--steps", "20", "--gaussians", "300", "--checkpoint", str(tmp_path / "checkpoint.h5")]
    poses = tmp_path / "poses.csv"
    views = "".join(f"{view},0.5,0.1,0.1\n" for view in range(SCAN.angles.size))
    poses.write_text(f"view,shift_col_px,roll_deg,tilt_deg\n{views}")
    bars = ["--method", "fista-tv", "--iterations", "3", "--uncertainty", "--cols", "1:39"]
    for name, options in (("fbp", ["--method", "fbp", "--poses", str(poses)]), ("r2", fit), ("bars", bars)):
        words = ["recon", str(path), *options, "-o", str(tmp_path / f"{name}.h5"), "--no-report", "--json"]
        done = CliRunner().invoke(main, words, catch_exceptions=False)
        assert done.exit_code == 0, done.output
        events += [json.loads(line) for line in done.stdout.splitlines()]
    record = read_reconstruction(tmp_path / "bars.h5")
    assert re.match(
        "The scan ended with the status 'stopped' after 49 frames. Enough.", str(record.parameters["scan_ended"])
    )
    fitted, centres = read_reconstruction(tmp_path / "r2.h5"), np.ones((SCAN.angles.size, 3))
    rest = {"view_centres_mm": centres, "roi": "0:4,0:4,0:4", "roi_found": "4 of 8 slices", "frames_per_view": 2}
    rest |= dict.fromkeys(("frames_unmeasured_in_part", "rows_unmeasured", "slices_by_another_method"), np.arange(2))
    parameters: dict[str, Any] = {**fitted.parameters, **rest}
    model = {**fitted.model, "view_centres": centres}
    write_reconstruction(tmp_path / "free.h5", replace(fitted, parameters=parameters, model=model))
    series = VolumeSeries(np.zeros(2), np.stack([record.volume.data] * 2))
    write_reconstruction(tmp_path / "series.h5", replace(record, series=series))
    volumes = paths(*(tmp_path / f"{name}.h5" for name in ("fbp", "r2", "bars", "free", "series")))
    assert unmatched(volumes, names("Volume file")) == (set(), set())
    assert unmatched(paths(tmp_path / "checkpoint.h5"), names("Checkpoint")) == (set(), set())
    assert_on_the_page(events)


def test_labels(tmp_path: Path) -> None:
    write_labels(tmp_path / "s.labels.json", [LabelledRun("floaters", 2, ((0, 1, 2, 3),))], 9)
    labels = json.loads((tmp_path / "s.labels.json").read_text(encoding="utf-8"))
    found = {*labels, *(f"anomalies.{key}" for key in labels["anomalies"][0])}
    assert unmatched(found, names("Labels")) == (set(), set())


def test_run_folder_and_events_of_a_scan(tmp_path: Path) -> None:
    ran = Ran(tmp_path, FakeInstrument(Faults(repeats={9})))
    assert ran.folder is not None
    found = {path.name for path in ran.folder.iterdir()}
    assert unmatched(found, names("Run folder")) == (set(), NOT_OF_EVERY_RUN)
    events = [json.loads(line) for line in (ran.folder / "events.jsonl").read_text(encoding="utf-8").splitlines()]
    assert {"state", "run_started", "frame", "flag", "scan_done", "done"} <= {event["event"] for event in events}
    assert_on_the_page(events)


def assert_on_the_page(events: Iterable[dict[str, object]]) -> None:
    """Every event has the keys that the page names, and no other unless the page leaves the list open."""
    named = {row[0].strip("`"): row[1] for row in rows("Events")}
    for event in events:
        said = named[str(event["event"])]
        keys, expected = set(event) - {"event", "time"}, set(re.findall("`([a-z_]+)`", said))
        assert keys >= expected if said.endswith("...") else keys == expected, event


def test_the_page_knows_the_vocabulary_of_a_scan() -> None:
    assert set(names("Events")) <= KINDS.keys()
