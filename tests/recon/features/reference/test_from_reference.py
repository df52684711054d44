"""FromReference: better than without where the reference is right, and otherwise exactly the volume of auto."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage as ndi

import recon
from recon.base.arrays import F32
from recon.base.decisions import Decisions
from recon.base.method import DataUse, ReconProblem, RunControl
from recon.base.view_data import Views
from recon.base.volume import Grid, Volume
from recon.features.reference.choice import ReferenceVerdict
from tests.recon.features.reference.scene import LEVEL, ROWS, Discs, N, balls_near_one_end, packed, psnr, scanned
from tests.slow_cases import others_slow

AUTO = recon.Auto((recon.Fbp(), recon.FistaTv()))
BEFORE = packed()
STATE = replace(
    BEFORE, turn=np.radians(1.2), shift=(2.3, -1.4), slit=4,
    level=BEFORE.level * np.random.default_rng(7).uniform(0.93, 1.07, len(BEFORE.level)),
)  # fmt: skip


def reference(scene: Discs = BEFORE) -> Volume:
    """The volume of a careful scan."""
    data, geometry = scanned(scene, 180, 1e5)
    return recon.reconstruct(data, geometry, recon.FistaTv()).volume


@pytest.fixture(scope="module")
def before() -> Volume:
    return reference()


@pytest.fixture(scope="module")
def state() -> tuple[F32, recon.Geometry]:
    return scanned(STATE, 24, 1e4, seed=1)


@pytest.fixture(scope="module")
def without(state: tuple[F32, recon.Geometry]) -> recon.Reconstruction:
    return recon.reconstruct(*state, AUTO)


def test_a_right_reference_is_used_and_shows_more(
    before: Volume, state: tuple[F32, recon.Geometry], without: recon.Reconstruction
) -> None:
    made = recon.reconstruct(*state, recon.FromReference(before, AUTO))
    assert made.method == "from-reference" and made.settings["reference_used"]
    assert made.chosen.startswith("The reference was used: root mean square residual in held-out projections")
    assert "ended_after" not in made.settings  # the last of several rounds has no --iterations that allows more
    truth = STATE.volume
    assert psnr(made.volume.data, truth) > psnr(without.volume.data, truth) + 1.5
    assert made.change is not None and made.displacement is not None
    moved = made.volume.data - made.change.data
    gap = replace(STATE, slit=-1).volume - truth  # what is missing in the slit
    shown = float((-made.change.data * gap).sum() / np.square(gap).sum())
    assert shown > 0.6, "the slit is a change"
    assert abs(float((moved - replace(STATE, slit=-1).volume).mean())) < 0.02 * LEVEL
    # state(r) = reference(r + u): u = R (r - shift) - r
    at = np.arange(N) - (N - 1) / 2
    expected = np.sin(STATE.turn) * (at - STATE.shift[0]) + np.cos(STATE.turn) * (0 - STATE.shift[1])
    middle = made.displacement[2, ROWS // 2, N // 4 : -N // 4, N // 2 - 1 : N // 2 + 1].mean(1)
    np.testing.assert_allclose(middle, expected[N // 4 : -N // 4], atol=0.5)
    assert not made.displacement[0].any()


def test_the_reference_of_another_sample_is_refused_to_the_bit(
    state: tuple[F32, recon.Geometry], without: recon.Reconstruction
) -> None:
    made = recon.reconstruct(*state, recon.FromReference(reference(packed(seed=9)), AUTO))
    np.testing.assert_array_equal(made.volume.data, without.volume.data)
    assert not made.settings["reference_used"] and made.change is None
    assert made.chosen.startswith(
        "The reference was not used: the reference does not predict held-out projections better than"
    )
    assert made.method == without.method


@pytest.mark.parametrize(
    ("kind", "because"),
    [
        ("none", "none was given"),
        ("empty", "the reference shows no material in the rows of the test"),
        ("above", "the reference ends above or below the rows of the test"),
    ],
)
def test_without_a_usable_reference_the_volume_is_that_of_auto(
    kind: str, because: str, state: tuple[F32, recon.Geometry], without: recon.Reconstruction, before: Volume
) -> None:
    above = replace(before.grid, centre=(1e3 * ROWS, 0.0, 0.0))
    empty, elsewhere = Volume(np.zeros_like(before.data), before.grid), Volume(before.data, above)
    given = {"none": None, "empty": empty, "above": elsewhere}[kind]
    made = recon.reconstruct(*state, recon.FromReference(given, AUTO))
    np.testing.assert_array_equal(made.volume.data, without.volume.data)
    assert made.settings["reference_because"] == because


def test_too_few_projections_leave_the_reference_out(before: Volume) -> None:
    data, geometry = scanned(STATE, 12, 1e4)
    made = recon.reconstruct(data, geometry, recon.FromReference(before, AUTO))
    assert "12 projections are too few to hold any out" in made.settings["reference_because"]
    np.testing.assert_array_equal(made.volume.data, recon.reconstruct(data, geometry, AUTO).volume.data)


def test_weights_of_rays_are_used(before: Volume, state: tuple[F32, recon.Geometry]) -> None:
    data, geometry = state
    spoiled, weights = data.copy(), np.ones_like(data)
    spoiled[::3, :, 20:24], weights[::3, :, 20:24] = 0, 0
    made = recon.reconstruct(spoiled, geometry, recon.FromReference(before, AUTO), use=DataUse(weights))
    assert made.settings["reference_used"]
    assert psnr(made.volume.data, STATE.volume) > psnr(
        recon.reconstruct(data, geometry, AUTO).volume.data, STATE.volume
    )


def test_with_few_projections_the_last_iterations_use_half_voxels(before: Volume) -> None:
    """20 projections are fewer than a third of the 64 columns.

    With this noise, the residual of half voxels in held-out projections is 2.4 % larger, so the program rejects them.
    Here they are used because the stored decision is replaced.
    """
    data, geometry = scanned(STATE, 20, 1e4, seed=1)
    decide, method = Decisions(), recon.FromReference(before, AUTO)
    tested = recon.reconstruct(data, geometry, method, control=RunControl(decide=decide))
    verdict = ReferenceVerdict.of(decide.made["reference"][0])
    assert verdict.used and not verdict.half_voxels and "half_voxel_iterations" not in tested.settings
    passed = {**decide.made, "reference": [verdict._replace(half_voxels=True)]}
    halves = recon.reconstruct(data, geometry, method, control=RunControl(decide=Decisions(0, passed)))
    again, never = RunControl(decide=Decisions(0, passed)), replace(method, half_voxels=False)
    whole = recon.reconstruct(data, geometry, never, control=again)
    assert 0 < halves.settings["half_voxel_iterations"] <= 12
    assert "half_voxel_iterations" not in whole.settings
    assert halves.history[-1].step > whole.history[-1].step
    np.testing.assert_array_equal(whole.volume.data, tested.volume.data)
    truth, x, other = STATE.volume, halves.volume.data, whole.volume.data
    slit = ndi.binary_dilation(replace(STATE, slit=-1).volume > truth, iterations=2)
    assert psnr(x, truth) > psnr(other, truth)
    assert np.square(x - truth)[slit].mean() < 0.96 * np.square(other - truth)[slit].mean()
    tall = replace(geometry, detector_shape=(64, N), axis_row=31.5)
    grid = Grid.matching(tall)
    assert method.memory(tall, grid, False) > 1.4 * never.memory(tall, grid, False)


def test_half_voxels_that_predict_as_well_are_used(before: Volume) -> None:
    """With the noise of this seed, their residual in held-out projections is 0.6 % larger."""
    data, geometry = scanned(STATE, 20, 1e4, seed=2)
    made = recon.reconstruct(data, geometry, recon.FromReference(before, AUTO))
    assert 0 < made.settings["half_voxel_iterations"] <= 12


def test_presets_ask_for_half_voxels_or_for_none() -> None:
    method = recon.FromReference(otherwise=AUTO)
    wanted = {quality: method.with_quality(quality, 0).half_voxels for quality in ("preview", "standard", "best")}
    assert wanted == {"preview": False, "standard": None, "best": True}


@pytest.mark.parametrize(
    "rows, beyond, weighted, halves",
    others_slow(
        [(16, 16, False, False), (16, 16, True, False), (64, 16, False, False), (64, 16, True, False),
         (16, 16, False, True), (64, 16, True, True)], 1
    ),
)  # fmt: skip
def test_the_stated_memory_is_at_least_the_peak_of_a_slab(
    rows: int, beyond: int, weighted: bool, halves: bool, before: Volume, state: tuple[F32, recon.Geometry]
) -> None:
    """A slab, with rows of the reference beyond it. The first slab makes the tests, the others do not."""
    data, geometry = state
    shape = rows, N
    slab = replace(geometry, detector_shape=shape, axis_row=(rows - 1) / 2)
    # rows differ, so that a copy of the reference displaced along z predicts worse
    density = np.random.default_rng(0).uniform(0.8, 1.2, rows + 2 * beyond).astype(np.float32)
    tall = np.tile(before.data, (len(density) // ROWS, 1, 1)) * density[:, None, None]
    lines = np.tile(data, (1, rows // ROWS, 1)) * density[beyond : beyond + rows, None]
    method = recon.FromReference(Volume(tall, Grid(tall.shape, before.grid.voxel_size)), AUTO, halves)
    weights = np.ones((len(data), *shape), np.float32) if weighted else None
    problem = ReconProblem(Views(lines, slab, weights), Grid.matching(slab))
    few = Views(data, geometry, None if weights is None else np.ones_like(data))
    replace(method, reference=before).run(ReconProblem(few, Grid.matching(geometry)), RunControl())  # loads kernels
    stated = method.memory(slab, problem.grid, weighted) - tall.nbytes  # the reference is there before
    decide = Decisions()
    for _ in ("makes the tests", "follows the first slab"):
        tracemalloc.start()
        made = method.run(problem, RunControl(decide=decide))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert made.settings["reference_used"], made.chosen
        assert peak < stated < 1.5 * peak
        decide = Decisions(0, decide.made)


def test_it_stops_when_it_is_asked_to(before: Volume, state: tuple[F32, recon.Geometry]) -> None:
    steps: list[int] = []

    def stop() -> bool:
        return len(steps) > 3

    control = RunControl(should_stop=stop, on_progress=lambda progress: steps.append(progress.step) if not progress.unit
                         else None)  # fmt: skip
    made = recon.reconstruct(*state, recon.FromReference(before, AUTO), control=control)
    assert np.isfinite(made.volume.data).all() and made.history[-1].step <= 6


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_reference_with_a_voxel_that_is_not_finite_is_refused(
    value: float, before: Volume, state: tuple[F32, recon.Geometry]
) -> None:
    data = before.data.copy()
    data[1, 30, 30] = value
    with pytest.raises(ValueError, match=f"1 of {data.size} voxels of the reference are not finite"):
        recon.reconstruct(*state, recon.FromReference(Volume(data, before.grid), AUTO))


def test_in_a_cone_the_volume_is_that_of_auto(before: Volume, state: tuple[F32, recon.Geometry]) -> None:
    data, parallel = state
    cone = recon.Geometry.cone(parallel.angles, parallel.detector_shape, pixel_pitch=1.001, sod=1e5, sdd=1.001e5)
    made = recon.reconstruct(data, cone, recon.FromReference(before, AUTO))
    assert (
        made.settings["reference_because"]
        == "a reference is used only with a parallel beam, and this scan has a cone beam"
    )
    np.testing.assert_array_equal(made.volume.data, recon.reconstruct(data, cone, AUTO).volume.data)


@pytest.mark.slow
def test_a_slab_beyond_the_reference_is_made_by_auto(before: Volume, state: tuple[F32, recon.Geometry]) -> None:
    """With the decisions of the slab with most material, in which the reference was used."""
    decide, method = Decisions(), recon.FromReference(before, AUTO)
    assert recon.reconstruct(*state, method, control=RunControl(decide=decide)).settings["reference_used"]
    above = method.at_height(3.0 * ROWS + 20)
    made = recon.reconstruct(*state, above, control=RunControl(decide=Decisions(0, decide.made)))
    assert made.settings["reference_because"] == "the reference shows no material in this part of the volume"
    assert made.change is None
    np.testing.assert_array_equal(made.volume.data, recon.reconstruct(*state, AUTO).volume.data)


@pytest.mark.slow
def test_the_height_of_the_reference_is_that_of_the_rows_that_are_tested(rng: np.random.Generator) -> None:
    truth = balls_near_one_end(rng)
    geometry = recon.Geometry.parallel(np.pi * np.arange(30) / 30, (40, 48))
    grid = recon.Grid.matching(geometry)
    exact = recon.Projector(geometry, grid).forward(truth)
    data = -np.log(np.maximum(rng.poisson(1e4 * np.exp(-exact)), 1) / 1e4).astype(np.float32)
    method = recon.FromReference(Volume(truth, grid), AUTO)
    made = recon.reconstruct(data, geometry, method)
    assert made.settings["reference_used"] and made.displacement is not None
    assert psnr(made.volume.data, truth) > psnr(recon.reconstruct(data, geometry, AUTO).volume.data, truth) + 6
    material = truth > 0.02
    assert np.median(np.abs(made.displacement[0][material])) < 0.1, "it has not moved along the axis"
