"""The volume that is delivered next to a result: a direct reconstruction of the same projections."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recon
from beamline.core.events import Event
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.reconstruct.options import OutputPaths
from beamline.reconstruct.record import write_result
from beamline.reconstruct.scan_facts import MadeVolume, ReportContext, facts_of
from beamline.storage.readers.open import SourceOptions
from drivers.base.clock import SystemClock
from recon.base.geometry import Geometry
from recon.base.method import Reconstruction
from recon.base.view_data import Views
from recon.base.volume import Grid
from recon.voxels.projector import Projector
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import TwoCylinders, write_exchange
from tests.slow_cases import others_slow

pytestmark = pytest.mark.usefixtures("one_thread")

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(12, 40))


Scan = tuple[PreparedProjections, ReportContext]


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    path, selection = tmp_path_factory.mktemp("scan") / "scan.h5", Selection(axis_col=SCAN.axis_col)
    with SourceOptions(write_exchange(path, SCAN)).open() as source:
        context = ReportContext(facts_of(source), selection, "beamline recon scan.h5", 0)
    return prepare(path, selection)[0], context


def _written(made: Reconstruction, scan: Scan, output: Path) -> tuple[Any, list[str]]:
    """The volume beside a report: the last event's data, and all messages."""
    events: list[Event] = []
    target = OutputPaths(output, output.with_suffix(".html"))
    write_result(MadeVolume(made, scan[0], None, target, scan[1]), events.append, SystemClock())
    assert target.report is not None and target.report.exists()
    return events[-1].data, [str(event.data.get("message")) for event in events]


@pytest.mark.parametrize(("turn", "compared"), others_slow([(3.6, True), (2.8, False)]))
def test_a_cones_volume_is_compared_with_fdk_where_there_is_one(
    scan: Scan, tmp_path: Path, turn: float, compared: bool
) -> None:
    """Views of the same sample, magnified five times."""
    angles = np.linspace(0, turn, 30, endpoint=False)
    cone = Geometry.cone(angles, SCAN.shape, 5.0, 400.0, 2000.0, axis_col=SCAN.axis_col)
    grid = Grid.matching(cone)
    data = Projector(cone, grid).forward(SCAN.truth(grid))
    prepared = replace(scan[0], lines=Views(data, cone, ids=scan[0].ids))
    made = recon.reconstruct(data, cone, recon.OsSirtTv(iterations=3))
    done, _ = _written(made, (prepared, scan[1]), tmp_path / "out.h5")
    assert ("fbp" in done) is compared
    assert not compared or done["fbp"]["residual"] < 0.3
