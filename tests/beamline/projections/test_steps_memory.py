"""What steps on views take of the memory is what they state, and the budget counts it."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from beamline.projections.selection import Selection
from beamline.projections.steps.phase import Phase
from beamline.projections.steps.resampling import TiltAndLens
from beamline.projections.steps.step import ViewStep
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.result import OutputPaths
from beamline.reconstruct.slabs import needs_of
from beamline.storage.readers.open import SourceOptions, open_scan
from recon.prep.correct import Projections
from recon.prep.resample import Distortion
from recon.voxels.direct import Fbp
from tests.beamline.scans import TwoCylinders, write_exchange

LENS = Distortion.parse("xcenter = 80\nycenter = 120\nfactor0 = 1.0\nfactor1 = 2e-5\n")
PAGANIN = {"material": "100", "distance_mm": 50.0, "energy_kev": 25.0}
STEPS = [TiltAndLens(0.5), TiltAndLens(0.5, LENS), Phase(**PAGANIN), Phase(**PAGANIN, unsharp=(1.0, 0.5))]


def _options(path: Path, selection: Selection) -> ReconOptions:
    return ReconOptions(SourceOptions(path), OutputPaths(path.with_name("out.h5"), None), selection, Fbp())


@pytest.mark.parametrize("step", STEPS, ids=["tilt", "lens", "phase", "unsharp"])
def test_a_step_takes_no_more_memory_than_it_states_and_the_budget_has_it(step: ViewStep, tmp_path: Path) -> None:
    path = write_exchange(tmp_path / "scan.h5", TwoCylinders(shape=(240, 160)))
    selection = Selection(steps=(step,))
    with open_scan(SourceOptions(path)) as source:
        found, _ = step.on(source, selection)
        needs, plain = (needs_of(source, _options(path, each)) for each in (selection, Selection()))
    assert found is not None
    for n in (2, 6):
        masked, air = np.zeros((240, 160), bool), np.zeros((n, 2), np.float32)
        views = Projections(np.ones((n, 240, 160), np.float32), np.arange(n), 0.0, air, masked)
        found.apply(views, 0)
        tracemalloc.start()
        found.apply(views, 0)
        taken = tracemalloc.get_traced_memory()[1] / views.data[0].nbytes
        tracemalloc.stop()
        assert found.copies - 2 < taken < found.copies
    assert (needs.copies, plain.copies) == (found.copies, 0)
    assert needs.least >= needs.view + needs.filters > plain.view
