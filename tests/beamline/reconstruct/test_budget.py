"""A time limit leaves out only what its forecast says will be late, and reports what was left out."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beamline.core.events import Event
from beamline.projections.selection import Selection
from beamline.reconstruct.budget import in_budget
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.storage.readers.open import SourceOptions
from beamline.storage.writers.recon_file import read_reconstruction
from drivers.base.clock import SystemClock
from recon.assess.time_model import PRESETS
from recon.auto import Auto
from recon.base.geometry import Geometry
from recon.base.method import Method
from recon.base.volume import Grid
from recon.forecast import Forecast, Timing
from recon.splatting.r2 import R2
from recon.voxels.direct import Fbp
from recon.voxels.methods import FistaTv
from tests.beamline.scans import TwoCylinders, write_exchange
from tests.clock import SteppedClock

pytestmark = pytest.mark.usefixtures("one_thread")

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(6, 40))
SECONDS = {"fbp": 1.0, "fista-tv": 10.0, "discrete": 15.0, "pnp-dct": 30.0, "r2": 20.0}


def expected(self: Timing, method: Method) -> Forecast:
    """All are tried for a half of what they take, then the slowest may be run."""
    taken = [SECONDS[each.name] for each in method.alternatives]
    return Forecast(sum(taken) / 2 if len(taken) > 1 else 0.0, {method.name: max(taken)})


@pytest.mark.parametrize(
    ("budget", "left", "late"),
    [
        (99.0, ["fbp", "fista-tv", "discrete", "pnp-dct", "r2"], False),
        (60.0, ["fbp", "fista-tv", "discrete", "r2"], False),
        (44.0, ["fbp", "fista-tv", "discrete", "r2"], False),
        (42.0, ["fbp", "fista-tv", "discrete"], False),
        (27.0, ["fbp", "fista-tv"], False),
        (15.0, ["fbp"], False),
        (0.5, ["fbp"], True),
    ],
)
def test_the_slowest_is_left_out_until_the_choice_ends_in_time(
    monkeypatch: pytest.MonkeyPatch, budget: float, left: list[str], late: bool
) -> None:
    monkeypatch.setattr(Timing, "of", expected)
    views, warned = Geometry.parallel(np.linspace(0, 3, 20), (4, 16)), list[str]()
    method, words = in_budget(Auto(), budget, views, Grid.matching(views), SteppedClock(0.0, 0.0), warned.append)
    assert [each.name for each in method.alternatives] == left
    assert [f"about {0.5 * late:.3g} s after this limit" in said for said in warned] == [True] * late
    assert all((f"with {name}, tests and volume would take about" in words) == (name not in left) for name in SECONDS)
    times = [float(each) for each in re.findall(r"volume would take about ([0-9.]+) s", words)]
    assert all(each > budget for each in times) and words.endswith(f"; about {budget:.3g} s remained") is bool(times)
    assert words.startswith(f"{budget:.3g} s for {' or '.join(left)}")


def test_what_does_not_take_the_views_is_no_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuses(self: Timing, method: Method) -> Forecast:
        if any(isinstance(each, Fbp) for each in method.alternatives):
            raise ValueError("no direct method")
        return expected(self, method)

    monkeypatch.setattr(Timing, "of", refuses)
    views = Geometry.parallel(np.linspace(0, 3, 20), (4, 16))
    method, _ = in_budget(Auto(), 20.0, views, Grid.matching(views), SteppedClock(0.0, 0.0), lambda said: None)
    assert method.name == "fista-tv"
    with pytest.raises(ValueError, match="fbp: no direct method"):
        in_budget(Auto((Fbp(),)), 20.0, views, Grid.matching(views), SteppedClock(0.0, 0.0), lambda said: None)


@pytest.mark.slow
def test_a_run_in_a_budget_is_that_of_the_methods_left(tmp_path: Path) -> None:
    write_exchange(tmp_path / "scan.h5", SCAN)
    volumes, events = [], list[Event]()
    for name, budget in (("whole", None), ("budget", 1000.0), ("short", 1e-3)):
        options = ReconOptions(
            SourceOptions(tmp_path / "scan.h5"), OutputPaths(tmp_path / f"{name}.h5", None),
            Selection(axis_col=SCAN.axis_col), method=Auto((Fbp(), FistaTv(20))), budget=budget,
        )  # fmt: skip
        reconstruct_file(options, events.append, SystemClock())
        volumes.append((read_reconstruction(tmp_path / f"{name}.h5"), events[-1].data.get("chosen", "")))
    (whole, _), (same, chosen), (short, too_few) = volumes
    np.testing.assert_array_equal(whole.volume.data, same.volume.data)
    assert same.parameters["budget"] == 1000 and "16.7 min for fbp or fista-tv" in chosen
    assert short.method == "fbp" and "with fista-tv, tests and volume would take about" in too_few
    assert any("0.001 s is too short for this scan" in str(event.data) for event in events)


@pytest.mark.slow
def test_a_preset_is_told_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_exchange(tmp_path / "scan.h5", SCAN)
    options = ReconOptions(
        SourceOptions(tmp_path / "scan.h5"), OutputPaths(tmp_path / "out.h5", None), Selection(axis_col=SCAN.axis_col),
        quality="preview",
    )  # fmt: skip
    events: list[Event] = []
    reconstruct_file(options, events.append, SystemClock())
    record = read_reconstruction(tmp_path / "out.h5")
    preview = PRESETS["preview"]
    assert record.parameters["steps"] == preview.steps
    count = round(preview.share * 2000)  # a small volume: the least that a fit starts from by itself
    assert events[-1].data["chosen"].startswith(f"preview: {preview.steps} steps from {count} Gaussians")
    plain = replace(options, quality=None, method=R2(steps=5), target=OutputPaths(tmp_path / "plain.h5", None))
    reconstruct_file(plain, events.append, SystemClock())
    assert "chosen" not in events[-1].data
