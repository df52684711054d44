"""Quality figures in a report: each row has its own, independent of the other rows."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.cli.terminal import results
from beamline.core.events import Event
from beamline.core.recon_events import VolumeDone
from beamline.core.stop import StopOnSignal
from beamline.projections.selection import Selection
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.storage.readers.open import SourceOptions
from beamline.storage.recon_record import ReconRecord
from drivers.base.clock import SystemClock
from recon.methods import build, by_name
from tests.beamline.scans import TwoCylinders, write_exchange

METHODS: dict[str, dict[str, Any]] = {
    "fbp": {}, "sirt": {"iterations": 20}, "cgls": {"iterations": 6}, "fista-tv": {"iterations": 8}
}  # fmt: skip


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Views with so much noise that FBP, smoothed volumes and the truth have other voxels above a threshold."""
    rng = np.random.default_rng(5)
    made = TwoCylinders(angles=np.radians(np.arange(0, 180, 4.0)), shape=(8, 48), axis_col=23.5)
    counts = rng.poisson(100 + 400 * np.exp(-made.line_integrals()))
    changes = {"data": counts.astype(np.uint16), "data_white": np.full((2, *made.shape), 500, np.uint16)}
    return write_exchange(tmp_path_factory.mktemp("scan") / "scan.h5", made, changes)


def figures(scan: Path, folder: Path, method: str, axis_col: float) -> ReconRecord:
    """The record of a reconstruction with a report."""
    heard: list[Event] = []
    made = build(by_name(method), METHODS[method])
    target = OutputPaths(folder / f"{method}_{axis_col}.h5", folder / f"{method}_{axis_col}.html")
    options = ReconOptions(SourceOptions(scan), target, Selection(axis_col=axis_col), made)
    reconstruct_file(options, heard.append, SystemClock(), StopOnSignal())
    (done,) = (event for event in heard if isinstance(event, VolumeDone))
    return done.record


@pytest.mark.slow
def test_snr_and_cnr_of_fbp_are_the_same_beside_every_method(scan: Path, tmp_path: Path) -> None:
    alone = figures(scan, tmp_path, "fbp", 23.5).metrics
    assert "unexplained" not in alone  # the blur of its filter tells nothing
    for method in ("sirt", "cgls", "fista-tv"):
        done = figures(scan, tmp_path, method, 23.5)
        beside = done.compared
        assert beside is not None and "unexplained" in done.metrics
        assert abs(beside["air"]) < 1  # the ring around the cylinder, no corners and no matter
        assert {name: beside[name] for name in ("snr", "cnr")} == {name: alone[name] for name in ("snr", "cnr")}


def test_the_page_has_the_time_of_the_fit_and_of_the_whole_command(scan: Path, tmp_path: Path) -> None:
    done = figures(scan, tmp_path, "cgls", 23.5)
    text = re.sub(r"<[^>]*>|\s+", " ", (tmp_path / "cgls_23.5.html").read_text(encoding="utf-8"))
    assert done.report is not None and done.metrics["seconds"] < done.elapsed
    own, whole = (
        re.search(rf"{label}[^\d]*([\d.]+) s", text) for label in ("Time of reconstruction", "loading the program")
    )
    assert own is not None and whole is not None
    seconds = float(whole[1])
    assert done.metrics["seconds"] < seconds == round(done.elapsed, 1)
    assert f"{done.elapsed:.1f} s" in results(done)
