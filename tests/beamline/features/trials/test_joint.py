"""Views that show several volumes: by parts they are the method of each part, jointly they are the fits of recon."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from beamline.features.trials import worker
from beamline.features.trials.launch import TrialData, by_parts
from beamline.features.trials.tradeoff import plan_in_time, plan_of_energies
from beamline.features.trials.trial import Trial
from beamline.features.trials.worker import run, shown
from beamline.projections.prepared import PreparedProjections, with_views_held_out
from recon.base.arrays import F32
from recon.base.geometry import Geometry
from recon.base.method import Energies
from recon.base.volume import Grid, Volume
from recon.features.joint.energy_fit import EnergyViews
from recon.features.joint.series import TimedViews, fit_series
from recon.features.joint.spectral import fit_materials
from recon.voxels.fbp import fbp
from recon.voxels.projector import project
from tests.beamline.features.trials.test_worker import done
from tests.beamline.prepared_views import prepared_views

pytestmark = pytest.mark.usefixtures("one_thread")
VIEWS, HELD_OUT, SIDE, ROWS = 40, 5, 20, 2
SECTIONS = np.array([[0.2, 1.0], [1.0, 0.3]])  # [energy, material]
SHORT = {"weight": 0.01, "sweeps": 8}  # the weight is given, for fewer sweeps
SERIES = Trial("one fit", "series", VIEWS, settings={"volumes": 2, "moves": False, **SHORT})
MATERIALS = Trial("one fit", "materials", VIEWS, settings={"materials": "a,b"})


@pytest.fixture(autouse=True)
def _nothing_is_compiled_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "warm_up", lambda method, geometry: None)


def discs() -> F32:
    """Two volumes [z, y, x], a disc each."""
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    both = [np.hypot(x - 4, y) < 4, np.hypot(x + 4, y - 2) < 5]
    return np.repeat(np.stack(both)[:, None], ROWS, 1).astype(np.float32)


def data_of(weights: tuple[np.ndarray, ...], of_view: np.ndarray, **given: Callable[..., object]) -> TrialData:  # type: ignore[type-arg]
    """Views of sums of two discs with the weights of each view; the last five are held out."""
    angles = np.mod(np.arange(VIEWS + HELD_OUT) * 2.4, np.pi)
    geometry = Geometry.parallel(angles, (ROWS, SIDE))
    grid = Grid.matching(geometry)
    lines = [project(Volume(disc, grid), geometry) for disc in discs()]
    seen = sum(line * weight[:, None, None] for line, weight in zip(lines, weights, strict=True)).astype(np.float32)
    prepared = prepared_views(seen, geometry, **{name: of(of_view) for name, of in given.items()})
    unseen = np.arange(VIEWS, VIEWS + HELD_OUT)
    return TrialData(with_views_held_out(prepared, unseen), None, of_view[unseen].astype(np.float64))


@pytest.fixture
def in_time() -> TrialData:
    """The first disc fades while the second grows; views held out are of moments between the others."""
    times = np.concatenate((np.linspace(0, 10, VIEWS), np.linspace(1, 9, HELD_OUT)))
    return data_of((1 - times / 10, times / 10), times, times=lambda of_view: of_view)


@pytest.fixture
def of_energies() -> TrialData:
    energy = np.arange(VIEWS + HELD_OUT) % 2
    shares = SECTIONS[energy]
    return data_of((shares[:, 0], shares[:, 1]), energy, energies=lambda of_view: Energies(of_view, SECTIONS))


def plain_fbp(prepared: PreparedProjections) -> F32:
    return fbp(prepared.projections.data, prepared.geometry)


def test_parts_in_time_are_linear_between_their_middles(in_time: TrialData) -> None:
    order = np.random.default_rng(0).permutation(VIEWS)
    mixed = replace(in_time, prepared=in_time.prepared.of_views(order))
    volume_at = by_parts(2, mixed, plain_fbp)
    halves = [np.sort(np.argsort(mixed.shown)[half]) for half in (slice(0, 20), slice(20, 40))]
    first, last = (plain_fbp(mixed.prepared.of_views(half)) for half in halves)
    early, late = (mixed.shown[half].mean() for half in halves)
    for time, expected in ((0.0, first), (early, first), ((early + late) / 2, (first + last) / 2), (10.0, last)):
        np.testing.assert_allclose(volume_at(float(time)), expected, atol=1e-6)


def test_parts_of_energies_are_one_an_energy(of_energies: TrialData) -> None:
    volume_at = by_parts(2, of_energies, plain_fbp)
    for energy in (0, 1):
        own = np.flatnonzero(of_energies.shown == energy)
        expected = plain_fbp(of_energies.prepared.of_views(own))
        np.testing.assert_array_equal(volume_at(float(energy)), expected)


def kept(trial: Trial, data: TrialData, folder: Path) -> F32:
    """What the middle view shows of the trial's volumes."""
    run(trial, data, 0, keep=folder / "volume.npy")
    volume: F32 = np.load(folder / "volume.npy")
    return volume


def test_one_fit_in_time_is_that_of_recon(in_time: TrialData, tmp_path: Path) -> None:
    times = in_time.shown
    views = TimedViews(in_time.prepared.projections.data, in_time.geometry, times)
    expected = fit_series(views, 2, motion=False, tv_weight=0.01, sweeps=8)
    np.testing.assert_array_equal(kept(SERIES, in_time, tmp_path), expected.at(float(np.sort(times)[VIEWS // 2])))


def test_one_fit_of_energies_is_that_of_recon(of_energies: TrialData, tmp_path: Path) -> None:
    energy = of_energies.shown.astype(np.intp)
    made = fit_materials(EnergyViews(of_energies.prepared.projections.data, of_energies.geometry, energy, SECTIONS))
    at = kept(MATERIALS, of_energies, tmp_path)
    np.testing.assert_allclose(at, SECTIONS[1, 0] * made.densities[0] + SECTIONS[1, 1] * made.densities[1], rtol=1e-5)


def test_rays_that_were_not_measured_do_not_count(in_time: TrialData) -> None:
    measured = np.ones((ROWS, SIDE), np.bool_)
    measured[:, :3] = False
    assert in_time.prepared.held_out is not None
    unseen, geometry = in_time.prepared.held_out
    figures = []
    for filled in (0.0, 9.0):
        views = in_time.prepared.projections
        used, held = (np.where(measured, lines, np.float32(filled)) for lines in (views.data, unseen))
        given = replace(
            in_time.prepared, projections=replace(views, data=used), measured=measured, held_out=(held, geometry)
        )
        figures.append(run(SERIES, replace(in_time, prepared=given), 0)["squared_residuals"])
    np.testing.assert_array_equal(*figures)


def test_each_view_held_out_is_compared_with_the_volume_of_its_time(in_time: TrialData) -> None:
    """The truth leaves nothing of them; the volume of one moment does."""
    assert in_time.prepared.held_out is not None and in_time.shown_held_out is not None
    unseen, geometry = in_time.prepared.held_out
    grid = Grid.matching(geometry)

    def truth(time: float) -> F32:
        return np.tensordot(np.array([1 - time / 10, time / 10], np.float32), discs(), 1)

    views = partial(shown, of_view=in_time.shown_held_out, geometry=geometry, grid=grid)
    np.testing.assert_allclose(views(truth), unseen, atol=1e-4)
    assert np.abs(views(lambda time: truth(5.0)) - unseen).max() > 1


def test_what_changes_is_explained_better_by_one_fit_than_by_parts_or_one_volume(in_time: TrialData) -> None:
    one_volume = Trial("method", "fista-tv", VIEWS)
    trials = one_volume, replace(one_volume, group="parts", parts=2), SERIES
    ignoring, parts, joint = (run(trial, in_time, 0)["metrics"]["residual_held_out"] for trial in trials)
    assert joint < 0.5 * parts < 0.5 * ignoring


def test_a_share_of_states_is_explained_from_few_views(of_energies: TrialData) -> None:
    apart = run(Trial("parts", "fbp", VIEWS, parts=2), of_energies, 0)["metrics"]["residual_held_out"]
    for trial in (MATERIALS, replace(MATERIALS, settings={"materials": "a,b", "states": "a,b"})):
        found = run(trial, of_energies, 0)
        assert found["metrics"]["residual_held_out"] < 0.5 * apart
        assert found["gaussians"] is None and "sweep" in found["reached"] and found["cpu_seconds"] > 0


def test_times_and_energies_come_through_the_file(
    of_energies: TrialData, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert done(of_energies, tmp_path, MATERIALS) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["squared_residuals"] == pytest.approx(run(MATERIALS, of_energies, 0)["squared_residuals"])


def test_too_few_views_are_a_failed_trial(
    in_time: TrialData, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = replace(SERIES, settings={"volumes": 9, "moves": False})
    assert done(in_time, tmp_path, trial) == 1
    assert "9 volumes of 40 views" in json.loads(capsys.readouterr().out.splitlines()[-1])["message"]


def test_a_plan_in_time_ignores_it_then_parts_it_then_fits_all() -> None:
    trials = plan_in_time(("fbp", "sirt"), 72, 1000, 4)
    assert [t.group for t in trials] == ["method"] * 2 + ["parts"] * 6 + ["one fit"] * 3
    assert [t.parts for t in trials if t.group == "parts"] == [2, 2, 4, 4, 8, 8]
    assert [t.title for t in trials[-3:]] == [
        f"series, 4 volumes, motion {how}" for how in ("none", "learnt", "chosen")
    ]
    assert max(t.parts for t in plan_in_time(("fbp",), 30, 1000, 4)) == 4  # a part has six views or more


def test_a_plan_of_energies_has_a_share_where_there_are_states() -> None:
    trials = plan_of_energies(("fbp",), 60, 1000, 3, "ab", "ab")
    assert [t.label for t in trials] == [
        "fbp, 60 views, 3 parts", "materials, 60 views", "materials, 60 views, smooth share"
    ]  # fmt: skip
    assert [t.title for t in trials] == ["fbp, 3 parts", "materials", "materials, smooth share"]
    assert trials[:2] == plan_of_energies(("fbp",), 60, 1000, 3, "ab", "")
