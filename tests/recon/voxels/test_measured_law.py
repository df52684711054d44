"""The measured error model, compared with the error for a known ground truth; and its errors."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

import recon
from recon.base.error_law import ErrorLaw
from recon.base.geometry import Geometry
from recon.base.reach import SampleRadius
from recon.base.volume import Grid
from recon.voxels.measured_law import measured_law
from recon.voxels.priors import TvWeight
from recon.voxels.voxel_problem import VoxelProblem
from simulators.frame.shot import Detector
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder, Ellipsoid
from tests.messages import refused
from tests.slow_cases import others_slow

F32 = NDArray[np.float32]
SIDE, ROWS = 48, 8
PITCH = 1 / SIDE


def sample(balls: int) -> Phantom:
    rng, bodies = np.random.default_rng(4), []
    for _ in range(balls):
        r, turn, z = 0.3 * rng.random() ** 0.5, rng.uniform(0, 2 * np.pi), rng.uniform(-0.1, 0.1)
        at = float(r * np.cos(turn)), float(r * np.sin(turn)), float(z)
        bodies.append(Ellipsoid(tuple(rng.uniform(0.03, 0.08, 3).tolist()), 2.0, centre=at))
    return Phantom.of((Cylinder(0.42, 1.0, 2.0), *bodies))


@cache
def scan(n: int, photons: float, cols: int = SIDE) -> tuple[F32, Geometry, F32, F32]:
    """Views over half a turn in bit-reversed order, their geometry, frames of the open beam, and the truth."""
    rng, phantom = np.random.default_rng(0), sample(25)
    order = np.argsort([int(f"{k:012b}"[::-1], 2) for k in range(n)], kind="stable")
    geometry = Geometry.parallel(order * np.pi / n, (ROWS, cols), pixel_pitch=PITCH)
    detector = Detector.centred((3 * ROWS, 3 * cols), PITCH / 3)
    fine = np.stack([phantom.line_integrals(float(angle), detector) for angle in geometry.angles])
    clean = fine.reshape(n, ROWS, 3, cols, 3).mean((2, 4))
    views = -np.log(np.maximum(rng.poisson(photons * np.exp(-clean)), 1) / photons).astype(np.float32)
    open_beam = -np.log(rng.poisson(photons, (8, 32, cols)) / photons).astype(np.float32)
    return views, geometry, open_beam, phantom.attenuation(Grid.matching(geometry))


def measured(n: int, photons: float) -> tuple[ErrorLaw, float | None]:
    views, geometry, open_beam, _ = scan(n, photons)
    return measured_law(views, geometry, [n // 2, n], np.random.default_rng(1), open_beam)


law_of = cache(measured)


@cache
def true_gain(n: int, photons: float) -> float:
    """dB from half of the views to all, by FISTA-TV."""
    views, geometry, _, truth = scan(n, photons)
    volumes = [recon.reconstruct(views[:k], geometry.select(np.arange(k)), "fista-tv").volume for k in (n // 2, n)]
    half, whole = (float(np.mean((volume.data - truth) ** 2)) for volume in volumes)
    return 10 * math.log10(half / whole)


@pytest.mark.slow
def test_where_noise_makes_the_error_views_bring_what_is_predicted() -> None:
    law = law_of(96, 300)[0]
    assert law.n_views == 96 and law.exponent > 0.5
    assert law.gain(views=96).mean == pytest.approx(true_gain(192, 300), abs=0.6)


@pytest.mark.slow
def test_where_edges_make_the_error_views_bring_less() -> None:
    law = law_of(192, 1e6)[0]
    assert law.exponent < 0.4
    assert law.gain(views=192).mean < law_of(192, 300)[0].gain(views=192).mean - 0.5


def test_views_at_the_same_angles_bring_less_than_others() -> None:
    law = law_of(96, 300)[0]
    assert 0 < law.gain(again=32).mean < law.gain(views=32).mean


@pytest.mark.slow
@pytest.mark.parametrize(("n", "photons"), others_slow([(96, 300), (192, 300), (192, 3000)]))
def test_the_gain_of_the_last_pass_is_measured_apart_from_the_law(n: int, photons: float) -> None:
    _, gained = law_of(n, photons)
    assert gained == pytest.approx(true_gain(n, photons), abs=0.8)
    views, geometry, open_beam, _ = scan(n, photons)
    assert measured_law(views, geometry, [n], np.random.default_rng(1), open_beam)[1] is None


@pytest.mark.slow
def test_the_noise_of_the_open_beam_is_taken_off_the_residual() -> None:
    views, geometry, open_beam, _ = scan(192, 300)
    known, unknown = (
        measured_law(views, geometry, [96, 192], np.random.default_rng(1), frames)[1]
        for frames in (open_beam, open_beam * np.float32(0.3))
    )
    assert known is not None and unknown is not None
    assert unknown < known / 2  # the noise, which more views do not change, hides the fall of the error


@pytest.mark.slow
def test_wide_views_help_where_the_sample_is_wider_than_the_field() -> None:
    views, geometry, open_beam, _ = scan(96, 3000, cols=28)
    law = measured_law(views, geometry, [96], np.random.default_rng(1), open_beam)[0]
    assert 0 < law.offset < 1 and law.gain(wide=True).mean > 0
    assert law.noise + law.offset < 1
    assert law_of(96, 3000)[0].offset == 0


@pytest.mark.slow
def test_fewer_views_than_columns_leave_gaps_that_others_fill() -> None:
    views, geometry, open_beam, _ = scan(56, 1e6, cols=64)
    assert measured_law(views, geometry, [56], np.random.default_rng(1), open_beam)[0].exponent == 0.6


@pytest.mark.parametrize(("n", "gaps"), [(48, True), (96, False)])
def test_gaps_last_until_the_views_are_as_many_as_the_sample_is_columns_wide(
    monkeypatch: pytest.MonkeyPatch, n: int, gaps: bool
) -> None:
    """A sample of 56 columns on a field of 28. With gaps the law is known less well."""
    monkeypatch.setattr(
        "recon.voxels.beyond_field._radius_of",
        lambda views: SampleRadius(2 * views.geometry.reach, views.geometry.reach, 2 * views.geometry.reach, 0.02),
    )
    views, geometry, open_beam, _ = scan(n, 1e6, cols=28)
    law, gained = measured_law(views, geometry, [n, n], np.random.default_rng(1), open_beam)
    more = law.gain(views=40)
    assert (law.exponent == 0.6, more.at_most == more.high) == (gaps, gaps)
    assert gained is None  # no view came between the last two ends


def test_views_of_many_columns_are_binned(monkeypatch: pytest.MonkeyPatch) -> None:
    whole, columns = law_of(192, 300)[0], list[int]()
    monkeypatch.setattr("recon.voxels.measured_law._WORK", 192 * SIDE**2 - 1)
    balance_of = TvWeight.of_noise

    def noted(problem: VoxelProblem, start: F32, sweeps: int) -> TvWeight:
        columns.append(problem.data.shape[1])
        return balance_of(problem, start, sweeps)

    monkeypatch.setattr(TvWeight, "of_noise", noted)
    binned = measured(192, 300)[0]
    assert columns == [SIDE // 2]
    assert binned.n_views == 192 and binned.exponent == pytest.approx(whole.exponent, abs=0.15)


def test_the_same_seed_gives_the_same_law() -> None:
    assert measured(64, 300) == measured(64, 300)


def test_what_cannot_be_measured_is_refused() -> None:
    views, geometry, open_beam, _ = scan(96, 300)
    rng = np.random.default_rng(0)
    few = np.arange(39)
    with refused(ValueError):
        measured_law(views[few], geometry.select(few), [39], rng, open_beam)
    with refused(ValueError):
        measured_law(views, geometry, [96], rng, open_beam[:2])
    cone = Geometry.cone(geometry.angles, (ROWS, SIDE), pixel_pitch=PITCH, sod=5.0, sdd=7.0)
    with refused(ValueError):
        measured_law(views, cone, [96], rng, open_beam)
    with refused(ValueError):
        measured_law(np.zeros_like(views), geometry, [96], rng, open_beam)
