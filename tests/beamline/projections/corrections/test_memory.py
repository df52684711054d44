"""Correction steps use at most the memory that they state, and the memory budget counts it."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beamline.projections.corrections.air import Air
from beamline.projections.corrections.beam_hardening.hardening import Hardening
from beamline.projections.corrections.calibration.calibrate import Calibrate
from beamline.projections.corrections.phase.phase import Phase
from beamline.projections.corrections.resampling import TiltAndLens
from beamline.projections.corrections.rings.rings import Rings
from beamline.projections.preparation import Preparation
from beamline.projections.prepared import Corrected, PreparedProjections, ScanOrigin
from beamline.projections.protocols import PrepStep, ScanPart, ScanStep, ViewStep
from beamline.projections.selection import Selection
from beamline.projections.step import StepMemory
from beamline.projections.views import select
from beamline.reconstruct.memory import ReconMemory, recon_memory_of
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import SourceOptions, open_scan
from recon.base.geometry import Geometry
from recon.base.view_data import Views
from recon.prep.projections import Projections
from recon.prep.resample import Distortion
from recon.voxels.direct import Fbp
from tests.beamline.scans import TwoCylinders, write_exchange

LENS = Distortion.parse("xcenter = 80\nycenter = 120\nfactor0 = 1.0\nfactor1 = 2e-5\n")
PAGANIN: dict[str, Any] = {"material": "100", "distance_mm": 50.0, "energy_kev": 25.0}
ON_VIEWS = [TiltAndLens(0.5), TiltAndLens(0.5, LENS), Phase(**PAGANIN), Phase(**PAGANIN, unsharp=(1.0, 0.5))]
ON_ALL = {
    "sort": Rings("sort"),
    "vo": Rings("vo"),
    "auto": Air("auto"),
    "surface": Air("surface:1"),
    "gains": pytest.param(Calibrate(("gains",)), marks=pytest.mark.slow),
    "fit": Hardening("fit"),
    "aluminium": Hardening("Al:60kV,Al=1"),
}


def peak(work: Callable[[], object]) -> int:
    """Bytes that it takes at most, once everything is imported and loaded."""
    work()
    tracemalloc.start()
    work()
    found = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return found


def part_of(source: ScanSource, *steps: PrepStep) -> ScanPart:
    scan, views = select(source, Selection(steps=steps)), source.table.kinds == 0
    return ScanPart(scan, scan.selection.geometry(source.shape[1] / 2, source.table.angles[views]))


def needs(path: Path, *steps: PrepStep) -> ReconMemory:
    output = OutputPaths(path.with_name("out.h5"), None)
    options = ReconOptions(SourceOptions(path), output, Selection(steps=steps), Fbp())
    with open_scan(SourceOptions(path)) as source:
        return recon_memory_of(select(source, options.selection), options)


@pytest.mark.parametrize("step", ON_VIEWS, ids=["tilt", "lens", "phase", "unsharp"])
def test_a_step_takes_no_more_memory_than_it_states_and_the_budget_has_it(step: ViewStep, tmp_path: Path) -> None:
    path = write_exchange(tmp_path / "scan.h5", TwoCylinders(shape=(240, 160)))
    with open_scan(SourceOptions(path)) as source:
        part = part_of(source, step)
        found, _ = step.on(part.scan)
    assert found is not None
    for n in (2, 6):
        masked, air = np.zeros((240, 160), bool), np.zeros((n, 2), np.float32)
        views = Projections(np.ones((n, 240, 160), np.float32), np.arange(n), 0.0, air, masked)
        taken, view = peak(lambda views=views: found.apply(views, 0)), views.data[0].nbytes  # type: ignore[misc]
        assert step.memory(part).correcting - 2 * view < taken < step.memory(part).correcting
    others = () if isinstance(step, Phase) else (Phase(None),)
    assert needs(path, step, *others).steps.correcting == step.memory(part).correcting
    assert needs(path, Phase(None)).steps.correcting == 0


@pytest.mark.parametrize("step", ON_ALL.values(), ids=ON_ALL)
def test_a_step_on_all_views_takes_no_more_than_it_states(step: ScanStep) -> None:
    shape = n, rows, cols = 60, 12, 96
    angles, x = np.linspace(0, np.pi, n, endpoint=False), np.linspace(-1, 1, cols)
    disc = 2 * np.sqrt(np.clip(0.36 - x**2, 0, None)) - 0.1 + 0.03 * x
    rng = np.random.default_rng(0)
    views = disc + rng.normal(0, 0.01, shape) + rng.normal(0, 0.02, (rows, cols))  # noise, and gains of pixels
    unread: Any = None
    part = ScanPart(unread, Geometry.parallel(angles, (rows, cols), pixel_pitch=1.0, axis_col=(cols - 1) / 2))

    def work() -> None:
        data, ones = views.astype(np.float32), np.ones(n, np.float32)
        found = Projections(data, np.arange(n), 0.0, ones, np.zeros((rows, cols), bool))
        lines = Views(data, part.geometry, None, np.arange(n))
        prepared = PreparedProjections(lines, Corrected.of(found), ScanOrigin((cols - 1) / 2, None, n, "px", "counts"))
        assert step.apply(prepared, angles, lambda n, of: None).sentence

    assert 0.25 * step.memory(part).alone < peak(work) - 4 * views.size < step.memory(part).alone


def test_the_budget_counts_the_largest_step_that_is_alone_in_memory(tmp_path: Path) -> None:
    path = write_exchange(tmp_path / "scan.h5", TwoCylinders(shape=(4, 96)))
    steps = Air("none"), Rings("vo"), Hardening("fit"), Preparation(flat_fields="dynamic")
    with open_scan(SourceOptions(path)) as source:
        stated = [step.memory(part_of(source, *steps)) for step in steps]
    found = needs(path, *steps)
    assert found.steps == StepMemory.of_all(stated)
    large = replace(found, steps=StepMemory(alone=10**9))
    assert large.least == 10**9 > found.least and large.at_once - found.at_once > 9e8
    longest = steps[int(np.argmax([each.alone for each in stated]))]
    assert max(large.parts, key=large.parts.__getitem__) == f"the step {longest.name}"
