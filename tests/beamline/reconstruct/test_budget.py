"""A budget is kept, on a clock that ticks at each look and on a real one; and what was chosen is told."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import recon
from beamline.core.events import Event
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.reconstruct import budget as module
from beamline.reconstruct.budget import TimedChoice, binned, choices, paces_of, within
from beamline.reconstruct.options import OutputPaths, ReconOptions
from beamline.reconstruct.pipeline import reconstruct_file
from beamline.storage.readers.open import SourceOptions
from beamline.storage.writers.recon_file import read_reconstruction
from drivers.base.clock import SystemClock
from recon.assess.metrics import psnr
from recon.assess.time_model import PRESETS
from recon.base.geometry import Geometry
from recon.base.method import Method, ReconProblem, Reconstruction, RunControl
from recon.base.volume import Grid, Volume
from recon.forecast import Pace
from recon.splatting.in_time import FinishPlan
from recon.splatting.r2 import R2
from recon.splatting.settings import FitSettings
from recon.voxels.direct import Fbp
from recon.voxels.methods import FistaTv, OsSirtTv
from recon.voxels.projector import Projector
from recon.warm_up import warm_up
from tests.beamline.prepared_views import prepare
from tests.beamline.scans import TwoCylinders, write_exchange
from tests.clock import SteppedClock
from tests.slow_cases import others_slow

pytestmark = pytest.mark.usefixtures("one_thread")

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(6, 40))
PACE = 0.7  # of an iteration of OS-SIRT-TV over a sweep of FISTA-TV


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> PreparedProjections:
    path = write_exchange(tmp_path_factory.mktemp("prepared") / "scan.h5", SCAN)
    return prepare(path, Selection(views="fixed:24", axis_col=SCAN.axis_col))[0]


def _spend(
    prepared: PreparedProjections,
    budget: float,
    now: SteppedClock,
    warned: list[str] | None = None,
    methods: Sequence[Method] = (R2(), Fbp()),
) -> Reconstruction:
    said = [] if warned is None else warned
    return within(budget, prepared, methods, 0, RunControl(now=now), said.append)[0]


def _as_fast_as(monkeypatch: pytest.MonkeyPatch, fbp: float, start: float, step: float, sweep: float) -> None:
    """Seconds of FBP, of the start of a fit beside it, of a step, and of a sweep over voxels."""
    paces = {
        "fbp": Pace(fbp, 0.0, 0),
        "r2": Pace(fbp + start, step, 0),
        "fista-tv": Pace(0.0, sweep, 0),
        "os-sirt-tv": Pace(0.0, PACE * sweep, 0),
    }
    monkeypatch.setattr(module, "paces_of", lambda methods, *_: {m.name: paces[m.name] for m in methods})


@pytest.mark.parametrize("budget", others_slow([5.0, 8.0, 12.0], 2))
def test_the_time_is_used_and_not_exceeded(
    prepared: PreparedProjections, monkeypatch: pytest.MonkeyPatch, budget: float
) -> None:
    """Whatever was predicted, the fit gets what is left after placing, and ends before filling would be late."""
    _as_fast_as(monkeypatch, 0.1, 0.2, 0.01, 0.01)
    monkeypatch.setattr("recon.splatting.in_time.finish_within", lambda *_: FinishPlan(0, 0.0))  # no ticks
    done = _spend(prepared, budget, SteppedClock(100.0, 0.01))
    assert done.settings["chosen_method"] == "r2"
    assert 0.9 * budget < done.seconds <= budget
    assert done.volume.grid == Grid.matching(prepared.geometry)
    assert f"of {budget:.3g} s" in done.chosen
    assert done.settings["kernel"] is FitSettings().kernel
    assert np.isfinite(done.history[-1].held_out)  # six views were not chosen


def test_iterations_on_voxels_take_a_sample_that_is_wider_than_the_field(
    prepared: PreparedProjections, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a box as wide as the sample; and where pixels must not be binned they are not."""
    _as_fast_as(monkeypatch, 0.01, 0.2, 0.001, 0.001)
    found, views = prepared.projections, prepared.geometry
    inner = replace(found, data=np.ascontiguousarray(found.data[..., 11:31]), masked=found.masked[:, 11:31])
    cut = Geometry.parallel(views.angles, (6, 20), axis_col=views.axis_col - 11)
    narrow = replace(prepared, projections=inner, geometry=cut, held_out=None)
    methods = (FistaTv(), R2(), Fbp())
    for data in (prepared, narrow):
        done = within(4.0, data, methods, 0, RunControl(now=SteppedClock(100.0, 0.01)), lambda said: None, 1)[0]
        assert "fista-tv" in done.settings["chosen_because"] and done.settings["chosen_binning"] == 1


@pytest.mark.slow
def test_too_little_time_leaves_the_cheapest_choice_which_is_said_to_be_late(
    prepared: PreparedProjections, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SteppedClock(100.0, 0.01)
    _as_fast_as(monkeypatch, 4320.0, 60.0, 3.0, 9.0)
    warned: list[str] = []
    done = _spend(prepared, 5.0, clock, warned)
    binned_pixels = done.settings["chosen_binning"]
    assert done.settings["chosen_method"] == "fbp" and binned_pixels >= 4  # about as many as six rows allow
    assert done.seconds < 5 and "of 5 s" in done.chosen
    named = f"fbp, binned {binned_pixels} x {binned_pixels}"
    assert len(warned) == 1 and f"5 s are too few for this scan: the cheapest choice, {named}, will be" in warned[0]
    _spend(prepared, 4320.0, clock, warned)
    assert len(warned) == 1


@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e2), st.floats(1e-3, 1e2), st.integers(1, 64))
def test_a_choice_takes_no_more_than_its_time_where_any_does(
    seconds: float, fbp: float, step: float, largest: int
) -> None:
    """Nothing is binned that need not be; and a longer time takes no fewer steps."""
    paces = {"fbp": Pace(fbp, 0.0, 0), "r2": Pace(3 * fbp, step, 0)}
    able, longer = (choices(paces, time, largest) for time in (seconds, 2 * seconds))
    if len(able) > 1 or able[0].seconds <= seconds:
        assert all(each.seconds <= seconds for each in able)
        assert able[0].binning == 1 or fbp / (able[0].binning / 2) ** 3 > seconds
    assert all(each.binning <= largest for each in able) and longer[0].binning <= able[0].binning
    steps = [{each.method: each.steps for each in some} for some in (able, longer)]
    assert longer[0].binning < able[0].binning or all(n <= steps[1][name] for name, n in steps[0].items())


def test_paces_come_from_steps_that_are_run(prepared: PreparedProjections) -> None:
    """On a clock that ticks at each look; a method that refuses the views is left out, unless all do."""
    now = SteppedClock(100.0, 0.01)
    paces = paces_of([R2(), Fbp(), FistaTv()], prepared.geometry, prepared.box, now)
    assert set(paces) == {"r2", "fbp", "fista-tv"} and paces["fbp"].each == 0
    assert all(pace.fixed > 0 for pace in paces.values()) and paces["r2"].each > 0
    short = _cone(prepared, 2.8)
    assert set(paces_of([Fbp(), FistaTv()], short.geometry, short.box, now)) == {"fista-tv"}
    with pytest.raises(ValueError, match="fbp"):
        paces_of([Fbp()], short.geometry, short.box, now)


@pytest.fixture
def high(prepared: PreparedProjections) -> PreparedProjections:
    """The same views, 64 rows high."""
    views = Geometry.parallel(
        prepared.geometry.angles, (64, 40), pixel_pitch=prepared.geometry.pixel_pitch, axis_col=SCAN.axis_col
    )
    data = np.repeat(prepared.projections.data[:, 2:3], 64, axis=1)
    noise = np.random.default_rng(0).normal(0, 0.02, data.shape).astype(np.float32)
    return replace(
        prepared, projections=replace(prepared.projections, data=data + noise), geometry=views, held_out=None
    )


@dataclass(frozen=True)
class Costly(OsSirtTv):
    """OS-SIRT-TV that takes its curve's pace an iteration on 64 rows; its volume is too large by a factor."""

    clock: SteppedClock = field(default_factory=lambda: SteppedClock(100.0))
    factor: float = 1.0
    ran: list[tuple[int, int]] = field(default_factory=list)

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        rows = problem.geometry.detector_shape[0]
        self.ran.append((rows, self.iterations))
        found = OsSirtTv(iterations=5).run(problem, RunControl())
        self.clock.time += self.iterations * PACE * rows / 64
        return replace(found, volume=replace(found.volume, data=found.volume.data * np.float32(self.factor)))


def test_of_several_methods_the_one_that_predicts_unseen_views_best_gets_the_rest_of_the_time(
    high: PreparedProjections, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SteppedClock(100.0)
    _as_fast_as(monkeypatch, 0.5, 2e06, 1.0, 1.0)
    for factor, expected in ((1.0, "os-sirt-tv"), (3.0, "fbp")):
        costly = Costly(clock=clock, factor=factor)
        begin = clock.time
        done = _spend(high, 20.0, clock, methods=(costly, Fbp()))
        assert done.method == expected
        because = done.settings["chosen_because"]
        assert because.startswith("trials on rows ") and "os-sirt-tv " in because and because in done.chosen
        (rows, tried), *final = costly.ran
        assert rows == 32
        assert clock.time - begin == pytest.approx(done.seconds) and done.seconds <= 20.0
        # The method that was chosen gets the time that is left, which the trial's was a part of.
        assert [r for r, _ in final] == ([64] if expected == costly.name else [])
        assert all(n >= tried for _, n in final)


def test_without_a_trial_the_curves_of_other_scans_decide(
    prepared: PreparedProjections, high: PreparedProjections, monkeypatch: pytest.MonkeyPatch
) -> None:
    _as_fast_as(monkeypatch, 0.5, 2e06, 1.0, 1.0)
    few = _spend(prepared, 20.0, SteppedClock(100.0), methods=(OsSirtTv(), Fbp()))
    assert few.method == "os-sirt-tv"
    because = few.settings["chosen_because"]
    assert because.startswith("os-sirt-tv was best on other scans; nothing was tried: the scan has too few rows")
    clock = SteppedClock(100.0)
    slow = Costly(clock=clock)
    monkeypatch.setattr(Costly, "run", lambda self, problem, control: _wait(clock, 12.0, problem))
    late = _spend(high, 20.0, clock, methods=(slow, Fbp()))
    assert late.settings["chosen_because"].endswith("too little time") and late.seconds >= 12.0


def _wait(clock: SteppedClock, seconds: float, problem: ReconProblem) -> Reconstruction:
    clock.time += seconds
    return Reconstruction(Volume(np.zeros(problem.grid.shape, np.float32), problem.grid), {})


def test_a_method_on_voxels_ends_in_time_with_what_it_has(
    high: PreparedProjections, monkeypatch: pytest.MonkeyPatch
) -> None:
    _as_fast_as(monkeypatch, 0.1, 2e06, 1.0, 0.1)
    done = _spend(high, 3.0, SteppedClock(100.0, 0.1), methods=(FistaTv(),))
    last = done.history[-1]
    assert 1 < last.step < last.steps and done.seconds <= 3.5 and done.settings["chosen_because"] == ""
    assert done.chosen.startswith(f"fista-tv, {last.step} iterations: ")


def _cone(
    prepared: PreparedProjections, turn: float, magnification: float = 10.0, tilt: float = 0.0
) -> PreparedProjections:
    """A cone's views of the same cylinders by the voxel projector, on pixels as large at the axis as before."""
    pitch = prepared.geometry.pixel_pitch
    angles = np.linspace(0, turn, 36, endpoint=False)
    cone = Geometry.cone(
        angles, SCAN.shape, magnification * pitch, 400.0, 400.0 * magnification, axis_col=SCAN.axis_col, tilt=tilt
    )
    grid = Grid.matching(cone)
    assert grid == Grid.matching(prepared.geometry)
    data = Projector(cone.straightened(), grid).forward(SCAN.truth(grid))
    return replace(
        prepared, projections=replace(prepared.projections, data=data), geometry=cone, held_out=None, n_projections=36
    )


@pytest.mark.slow
def test_a_cones_budget_counts_pixels_at_the_axis(prepared: PreparedProjections) -> None:
    """Magnified ten times, a pixel is ten voxels wide on the detector, and one at the axis."""
    cone = _cone(prepared, 2 * np.pi)
    done = _spend(cone, 8.0, SteppedClock(100.0, 0.01))
    grid = Grid.matching(cone.geometry)
    assert done.settings["chosen_method"] == "r2" and done.volume.grid == grid
    truth = SCAN.truth(grid)
    direct = psnr(truth, recon.reconstruct(cone.projections.data, cone.geometry, "fbp", grid=grid).volume.data)
    assert psnr(truth, done.volume.data) > direct + 1
    same_rays = _spend(_cone(prepared, 2 * np.pi, 2.0), 8.0, SteppedClock(100.0, 0.01))
    assert done.history[-1].residual == pytest.approx(same_rays.history[-1].residual, rel=1e-3)


@pytest.mark.parametrize("views", ["parallel", "of a cone", "that lean"])
def test_a_slow_machine_takes_the_direct_method_of_binned_pixels(
    prepared: PreparedProjections, monkeypatch: pytest.MonkeyPatch, views: str
) -> None:
    _as_fast_as(monkeypatch, 20.0, 60, 3.0, 9.0)
    cone = {"of a cone": 0.0, "that lean": 0.02}
    seen = _cone(prepared, 2 * np.pi, tilt=cone[views]) if views in cone else prepared
    done = _spend(seen, 5.0, SteppedClock(100.0, 0.01))
    assert (done.method, done.settings["chosen_method"], done.settings["chosen_binning"]) == ("fbp", "fbp", 2)
    assert done.volume.grid.shape == (3, 20, 20)
    assert "binned 2 x 2" in done.chosen and done.chosen.startswith("fbp")


def test_views_without_a_direct_method_get_the_shortest_fit(
    prepared: PreparedProjections, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Less than a short scan of a cone is for neither FBP nor FDK."""
    _as_fast_as(monkeypatch, 20.0, 60, 3.0, 9.0)
    done = _spend(_cone(prepared, 2.8), 5.0, SteppedClock(100.0, 0.01))
    assert done.settings["chosen_method"] == "r2" and done.method == "r2" and done.settings["chosen_binning"] == 4
    assert done.history[-1].step > 0 and 0 < done.settings["gaussians_at_start"] < 100
    assert done.volume.data.max() > 0


def test_binned_views_keep_their_scale_and_place(prepared: PreparedProjections) -> None:
    assert binned(prepared, 1) is prepared
    half = binned(prepared, 2)
    assert half.geometry.pixel_pitch == 2 * prepared.geometry.pixel_pitch
    assert half.projections.data.shape == (24, 3, 20)
    assert half.projections.data.mean() == pytest.approx(prepared.projections.data.mean(), rel=1e-5)
    assert half.held_out is not None and half.held_out[0].shape[1:] == (3, 20)


@pytest.mark.slow
def test_a_binned_choice_reaches_truth_file_and_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_exchange(tmp_path / "scan.h5", SCAN)
    _as_fast_as(monkeypatch, 0.1, 0.2, 0.01, 0.01)
    monkeypatch.setattr(module, "choices", lambda *_: [TimedChoice("r2", 100, 2, 0.5)])
    np.save(tmp_path / "truth.npy", SCAN.truth(Grid(SCAN.shape[:1] + 2 * SCAN.shape[1:], 1.0)))
    options = ReconOptions(
        SourceOptions(tmp_path / "scan.h5"), OutputPaths(tmp_path / "out.h5", tmp_path / "out.html"),
        Selection(axis_col=SCAN.axis_col), budget=1.0, truth=str(tmp_path / "truth.npy"),
    )  # fmt: skip
    events: list[Event] = []
    metrics = reconstruct_file(options, events.append, SystemClock()).metrics
    record = read_reconstruction(tmp_path / "out.h5")
    assert record.volume.grid.shape == (3, 20, 20)
    assert (record.parameters["binning"], record.parameters["budget"]) == (2, 1.0)
    assert metrics["psnr"] > 15
    done = events[-1].data
    assert "binned 2 x 2" in done["chosen"]
    page = (tmp_path / "out.html").read_text(encoding="utf-8")
    assert done["chosen"] in page


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


@pytest.mark.slow
def test_a_real_budget_of_processor_seconds(prepared: PreparedProjections) -> None:
    """Four seconds, and a tenth of grace; other work on the machine does not count. That the time is used up, the
    first test shows."""
    warm_up()
    done = within(4.0, prepared, [R2()], 0, RunControl(now=time.process_time), lambda w: None)[0]
    assert done.settings["chosen_method"] == "r2"
    assert 1.5 < done.seconds < 4.4
    assert done.history[-1].residual < 0.2
