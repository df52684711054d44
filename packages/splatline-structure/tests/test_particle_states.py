"""Particles of a reference in a state: known changes are found, and a gone, a cracked and a foreign one are told."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from bench_states import errors_of, reference_of
from state_scenes import PITCH, States

import recon
from recon import Grid
from recon.features.reference.particle_states import ReferenceParticles, fit_state, numbers_of, reference_particles

SCENE = States(31, columns=96, rows=32, others=("phantom.size_um=8", "phantom.fill=0.35"))
OTHER = replace(SCENE, seed=32)
VIEWS = 45


@cache
def truth(seed: int = 31) -> np.ndarray:
    """The sample before it changed [z, y, x], in 1/mm."""
    scene = SCENE if seed == 31 else OTHER
    return scene.sample(0).start.attenuation(Grid.matching(scene.geometry(1)), 3)


@cache
def reference() -> ReferenceParticles:
    return reference_of(SCENE, truth())


def seen(volume: np.ndarray, noise: int = 0, turn: float = 0.0) -> tuple[np.ndarray, recon.Geometry]:
    """Noisy line integrals of a volume, whose sample is turned by `turn` radians."""
    geometry = SCENE.geometry(VIEWS)
    turned = recon.Geometry.parallel(geometry.angles + turn, geometry.detector_shape, pixel_pitch=PITCH)
    lines = recon.Projector(turned, Grid.matching(geometry)).forward(volume.astype(np.float32))
    counts = np.random.default_rng(noise).poisson(1e4 * np.exp(-lines.astype(float)))
    return (-np.log(np.maximum(counts, 0.5) / 1e4)).astype(np.float32), geometry


def inner(k: int) -> np.ndarray:
    """The voxels [z, y, x] of a body of the reference."""
    solid = truth() > 0.5 * truth().max()
    return (reference().owner == k + 1).transpose(2, 0, 1) & solid


def middle_bodies() -> np.ndarray:
    """Whole bodies, the largest first."""
    whole = np.flatnonzero(~reference().cut)
    return whole[np.argsort(-reference().voxels[whole])]


def test_the_parts_of_a_reference_are_its_volume() -> None:
    """Each voxel belongs to one body at most, so that bodies without a gap between them are not counted twice."""
    own = reference()
    np.testing.assert_array_equal(own.rest[own.owner == 0], own.volume[own.owner == 0])
    np.testing.assert_allclose(own.rest[own.owner > 0], own.around, atol=1e-6)
    for k in middle_bodies()[:3]:
        body, mine = own.bodies[k], own.owner == k + 1
        above = np.square((own.volume - own.around)[mine].astype(float)).sum()
        assert body.squares == pytest.approx(above, rel=1e-4)
        y, x, z = np.argwhere(mine & (own.volume > own.volume.max() / 2)).mean(0)
        np.testing.assert_allclose(body.centre, (y, x, z), atol=0.3)
        assert body.level == pytest.approx(truth().max() * PITCH - own.around, rel=0.03)


@pytest.mark.slow
def test_growth_grey_levels_and_shifts_of_the_scene_are_found() -> None:
    fit = fit_state(reference(), SCENE.lines(6, VIEWS), SCENE.geometry(VIEWS), None)
    found = errors_of(SCENE, reference(), numbers_of(reference(), fit), 6)
    assert fit.matches and found.usual.sum() > 8
    assert abs(found.grey[found.usual].mean()) < 0.6 and found.grey[found.usual].std() < 1.5
    assert abs(found.volume[found.usual].mean()) < 0.8 and found.volume[found.usual].std() < 1.8
    assert 0.55 < found.held[found.usual][:, :2].mean() <= 1


@pytest.mark.slow
def test_intervals_hold_what_has_not_changed_in_eight_of_ten_cases() -> None:
    held = []
    for noise in range(3):
        lines, geometry = seen(truth(), noise)
        numbers = numbers_of(reference(), fit_state(reference(), lines, geometry, None))
        for each in (numbers.grey_change, numbers.growth):
            some = each[~reference().cut]
            held.append((some[:, 1] <= 0) & (some[:, 2] >= 0))
    assert 0.65 < np.mean(held) < 0.95


@pytest.mark.slow
def test_a_gone_and_a_cracked_particle_are_told_and_no_others() -> None:
    gone, cracked = middle_bodies()[:2]
    volume = truth().copy()
    around = reference().around / reference().grid.voxel_size
    volume[inner(gone)] = around
    y = np.indices(volume.shape)[1]
    volume[inner(cracked) & (y == round(reference().bodies[cracked].centre[0]))] = around
    lines, geometry = seen(volume)
    numbers = numbers_of(reference(), fit_state(reference(), lines, geometry, None))
    verdicts = dict(enumerate(numbers.verdict))
    assert verdicts.pop(int(gone)) == "gone" and verdicts.pop(int(cracked)) == "cracked"
    whole = [verdict for k, verdict in verdicts.items() if not reference().cut[k]]
    assert whole.count("as before") >= len(whole) - 1
    assert np.isnan(numbers.growth[gone]).all() and np.isnan(numbers.shift[gone]).all()
    assert numbers.grey[gone, 0] < 0.3 * numbers.grey[middle_bodies()[3], 0]


@pytest.mark.slow
def test_a_sample_that_was_put_back_turned_is_found() -> None:
    turn = np.radians(1.5)
    lines, geometry = seen(truth(), turn=turn)
    fit = fit_state(reference(), lines, geometry, None)
    numbers = numbers_of(reference(), fit)
    own = np.array([body.centre for body in reference().bodies]) - (np.array(reference().volume.shape) - 1) / 2
    z, y, x = numbers.shift[..., 0].T / PITCH
    sign = np.sign(np.nansum(own[:, 1] * y - own[:, 0] * x))
    expected = sign * np.column_stack((np.sin(turn) * own[:, 1], -np.sin(turn) * own[:, 0]))
    expected -= (1 - np.cos(turn)) * own[:, :2]
    whole = ~reference().cut
    np.testing.assert_allclose(np.column_stack((y, x))[whole], expected[whole], atol=0.15)
    assert np.abs(z[whole]).max() < 0.15 and fit.matches


@pytest.mark.slow
def test_another_sample_does_not_match_and_gets_no_numbers() -> None:
    lines, geometry = seen(truth(32))
    fit = fit_state(reference(), lines, geometry, None)
    numbers = numbers_of(reference(), fit)
    assert not fit.matches and set(numbers.verdict) == {"not seen"} and np.isnan(numbers.grey).all()


def test_a_volume_without_particles_is_no_reference() -> None:
    empty = np.zeros((8, 16, 16), np.int32)
    with pytest.raises(ValueError, match="no particle was found"):
        reference_particles(np.ones(empty.shape, np.float32), empty, Grid(empty.shape))
