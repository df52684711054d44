"""The automatic choice: the best prediction of held-out projections, the part of the scan it uses, its report."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon.auto import Auto
from recon.base.decisions import Decisions, Prior
from recon.base.method import SWEEPS_OF_TRIALS, Method, ReconProblem, Reconstruction, RunControl
from recon.base.registry import LibraryError, loaded
from recon.base.view_data import Views
from recon.base.volume import Volume
from recon.methods import by_name
from recon.voxels.beyond_field import whole_reach
from recon.voxels.choice import Prediction, TrialChoice
from recon.voxels.direct import Fbp
from recon.voxels.methods import FistaTv
from recon.voxels.projector import Projector
from recon.voxels.trial import Trial
from recon.voxels.voxel_problem import VoxelProblem
from tests.messages import refused

F32 = NDArray[np.float32]
VIEWS = recon.Geometry.parallel(np.linspace(0, np.pi, 24, endpoint=False), (40, 32))
GRID = recon.Grid.matching(VIEWS)


@pytest.fixture(scope="module")
def truth() -> F32:
    z, y, x = np.meshgrid(*GRID.coordinates(), indexing="ij")
    ball = np.where(x**2 + (y - 3) ** 2 + (z / 2) ** 2 < 60, np.float32(0.05), np.float32(0))
    return np.where((abs(x) < 1) & (abs(y) < 6), np.float32(0), ball)


@pytest.fixture(scope="module")
def data(truth: F32) -> F32:
    noise = np.random.default_rng(0).normal(0, 0.01, (24, 40, 32))
    return Projector(VIEWS, GRID).forward(truth) + noise.astype(np.float32)


@dataclass(frozen=True)
class Scaled(Fbp):
    """FBP times a factor: a method of known quality."""

    factor: float = 1.0

    def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
        found = super().run(problem, control)
        volume = Volume(found.volume.data * np.float32(self.factor), found.volume.grid)
        return replace(
            found, volume=volume, settings={"factor": self.factor, "rows": problem.geometry.detector_shape[0]}
        )


def test_it_is_a_name_in_the_library(data: F32) -> None:
    by_name = recon.reconstruct(data, VIEWS, "auto", grid=GRID)
    assert by_name.method in [each.name for each in Auto().candidates] and by_name.chosen


def test_it_takes_the_method_that_predicts_unseen_views_best_and_says_so(data: F32) -> None:
    auto = Auto((Scaled(factor=0.5), Scaled(factor=1.0), Scaled(factor=1.5)))
    found = recon.reconstruct(data, VIEWS, auto)
    assert found.method == "fbp" and found.settings["factor"] == 1.0
    assert found.settings["rows"] == 40  # the whole scan in the end
    assert found.settings["chosen_method"] == "fbp"
    because = found.settings["chosen_because"]
    assert because.startswith("test reconstructions of 16 rows, root mean square residual in held-out projections")


def test_another_slab_takes_the_method_that_the_first_one_chose(data: F32) -> None:
    auto, first = Auto((Scaled(factor=0.5), Scaled(factor=1.0))), Decisions()
    recon.reconstruct(data, VIEWS, auto, control=recon.RunControl(decide=first))
    control = recon.RunControl(decide=Decisions(0, first.made))
    assert recon.reconstruct(0.5 * data, VIEWS, auto, control=control).settings["factor"] == 1.0  # alone it is 0.5


def test_the_volume_has_the_prior_of_its_trial_in_any_units(data: F32, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of other rays, whose units differ by powers of two; and no other trial is made for it."""
    auto = Auto((Fbp(), FistaTv()))
    decide = Decisions()
    problem = ReconProblem(Views(data, VIEWS), GRID)
    choice = auto.choose(problem, recon.RunControl())
    assert choice.prior is not None and choice.chosen == 1
    found = recon.reconstruct(data, VIEWS, auto, control=recon.RunControl(decide=decide)).volume.data
    np.testing.assert_array_equal(found, recon.reconstruct(data, VIEWS, FistaTv()).volume.data)
    monkeypatch.setattr("recon.voxels.trial.Trial.of", lambda *_: pytest.fail("a second trial"))
    other = Decisions()
    other.prior = choice.prior._replace(weight=64.0 * choice.prior.weight)
    scaled = recon.reconstruct(64.0 * data, VIEWS, FistaTv(), control=recon.RunControl(decide=other)).volume.data
    np.testing.assert_array_equal(scaled, 64.0 * found)
    assert other.made["weight"] == decide.made["weight"]


def test_a_blurred_volume_is_not_preferred_to_a_sharp_one(data: F32, truth: F32) -> None:
    found = recon.reconstruct(data, VIEWS, Auto((FistaTv(iterations=3, tv_weight=0.05), FistaTv())))
    assert found.settings["tv_weight"] is None


def test_a_method_that_does_not_take_the_views_is_left_out(data: F32) -> None:
    @dataclass(frozen=True)
    class Refusing(Fbp):
        def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
            raise ValueError("not these")

    assert recon.reconstruct(data, VIEWS, Auto((Refusing(), Scaled()))).settings["factor"] == 1.0
    with refused(ValueError):
        recon.reconstruct(data, VIEWS, Auto((Refusing(),)))


def test_a_method_whose_library_cannot_be_loaded_is_left_out(data: F32) -> None:
    @dataclass(frozen=True)
    class Lacking(Fbp):
        def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
            loaded("a_library_that_is_not_there")
            raise AssertionError

    because = recon.reconstruct(data, VIEWS, Auto((Scaled(), Lacking()))).settings["chosen_because"]
    assert "fbp: a_library_that_is_not_there cannot be loaded: No module named" in because
    few, views = data[:12], VIEWS.select(np.arange(0, 24, 2))
    with pytest.warns(UserWarning, match="fbp is not tried: a_library_that_is_not_there cannot be loaded"):
        assert recon.reconstruct(few, views, Auto((Scaled(factor=2.0), Lacking()))).settings["factor"] == 2.0
    with pytest.raises(LibraryError):
        recon.reconstruct(few, views, Auto((Lacking(),)))


def _reaching(data: F32, fields: float) -> Views:
    """The projections of a sample whose radius is stated in widths of the field."""
    return Views(data, VIEWS, reach=whole_reach(Views(data, VIEWS), fields * VIEWS.reach))


@pytest.mark.parametrize("method", [Auto(), *(by_name(name)() for name in ("fista-tv", "pnp-dct", "discrete", "r2"))])
def test_a_sample_slightly_wider_than_the_field_is_wide_for_every_method(
    method: Method, data: F32, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wider by less than a tenth, which the box alone does not tell."""
    asked = list[bool]()

    def of(problem: VoxelProblem, *_: object) -> None:
        asked.append(problem.wide)

    monkeypatch.setattr(Trial, "of", of)
    for wide in (True, False):
        method.toy().run(ReconProblem(_reaching(data, 1.05 if wide else 1.0), GRID), recon.RunControl())
        assert asked and set(asked) == {wide}
        asked.clear()


def test_patches_are_not_tried_of_a_sample_wider_than_the_field(data: F32, monkeypatch: pytest.MonkeyPatch) -> None:
    """Matter beside the field is in all views; they preferred patches where total variation was 0.4 dB better."""
    monkeypatch.setattr(Trial, "weight", 0.5)
    priors, problem = list[Prior | None](), ReconProblem(_reaching(data, 1.05), GRID)

    @dataclass(frozen=True)
    class Asking(Scaled):
        def predict(self, trial: Trial, so_far: TrialChoice) -> Prediction:
            priors.append(trial.prior)  # as a fit asks for that of its finish
            return trial.predicted(self)

    choice = Auto((Asking(), recon.PnpDct())).choose(problem, recon.RunControl())
    assert (
        choice.chosen == 0 and "pnp-dct not tried, because the sample is wider than the field of view" in choice.reason
    )
    assert priors == [Prior(0.5)]  # and none is sought for its volume


def test_where_nothing_can_be_tried_the_last_one_runs(data: F32) -> None:
    @dataclass(frozen=True)
    class Blank(Fbp):
        def run(self, problem: ReconProblem, control: RunControl) -> Reconstruction:
            return Reconstruction(Volume(np.zeros(problem.grid.shape, np.float32), problem.grid), {})

    found = recon.reconstruct(data[:12], VIEWS.select(np.arange(0, 24, 2)), Auto((Scaled(), Blank())))
    assert not found.volume.data.any() and "12 projections are too few" in found.settings["chosen_because"]


TURN = np.linspace(0, 2 * np.pi, 24, endpoint=False)


@pytest.mark.parametrize(
    ("axis_row", "slices", "where"),
    [
        (31.5, slice(20, 44), "16 rows"),  # the box there holds all their rays
        (31.5, slice(0, 8), "binned 2 x 2"),  # little matter in the middle
        (4.0, slice(20, 44), "binned 2 x 2"),  # the middle is not on the detector
    ],
)
def test_a_cone_is_tried_in_its_middle_or_at_half_the_resolution(axis_row: float, slices: slice, where: str) -> None:
    views = recon.Geometry.cone(TURN, (64, 64), 1.0, 200.0, 300.0, axis_row=axis_row)
    grid = recon.Grid.matching(views)
    ball = np.zeros(grid.shape, np.float32)
    ball[slices, 20:44, 22:40] = 0.02
    found = recon.reconstruct(Projector(views, grid).forward(ball), views, Auto((Scaled(factor=0.3), Scaled())))
    assert found.settings["factor"] == 1.0
    assert where in found.settings["chosen_because"]


def test_a_gain_of_a_percent_is_not_worth_another_method_unless_the_best_is_asked_for(data: F32) -> None:
    auto, left = Auto((Scaled(factor=0.8), Scaled(factor=0.803))), []
    for method in (auto, auto.with_quality("best", 1)):
        made = recon.reconstruct(data, VIEWS, method)
        left.append(made.settings["factor"])
    assert left == [0.8, 0.803]
    assert [type(each) for each in Auto().with_quality("preview", 1).candidates] == [Fbp, FistaTv]
    assert auto.with_quality("standard", 1) is auto


def test_a_stop_ends_the_trials(data: F32) -> None:
    control = recon.RunControl(should_stop=lambda: True)
    found = recon.reconstruct(data, VIEWS, Auto((Scaled(), Scaled(factor=2.0))), control=control)
    assert found.settings["chosen_because"] == "stopped before the choice"


def test_progress_counts_the_sweeps_of_trials(data: F32) -> None:
    seen: list[Any] = []
    control = recon.RunControl(on_progress=seen.append)
    recon.reconstruct(data, VIEWS, Auto((Scaled(), FistaTv())), control=control)
    trials = [each for each in seen if each.unit.startswith(SWEEPS_OF_TRIALS)]
    assert [each.step for each in trials] == list(range(1, len(trials) + 1)) and len(trials) > 40
    assert all(each.step <= each.steps for each in trials)


def test_views_of_zeros_are_refused() -> None:
    with refused(ValueError):
        recon.reconstruct(np.full((24, 40, 32), np.nan), VIEWS, Auto())
    with refused(ValueError):
        recon.reconstruct(np.zeros((24, 40, 32)), VIEWS, Auto())
