"""The cycle of a battery: particles grow, crack, heal and move as the settings say, and the truth tells it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recon.base.volume import Grid
from simulators.samples.bodies.solids import Ellipsoid
from simulators.samples.builders.packed.cathode import Cathode
from simulators.samples.builders.packed.cycle import Cycle
from simulators.samples.builders.packed.pieces import Piece
from simulators.samples.sample import Changing, sample_at
from simulators.scenes.scene import load_scene
from tests.refused_calls import refused_calls

CELL = Cathode(diameter=0.2, height=0.16, wall_um=5, size_um=20.0, fill=0.3, habits={"sphere": 1.0}, cracked=0.1)
STILL = Cycle(walk_um=0, walk_deg=0, swelling=0, bubble_um=0, cracked=0, inactive=0, spread=0)
SCENE: dict[str, Any] = {"phantom": {"kind": "cathode", "diameter": 0.2, "height": 0.16, "size_um": 20.0, "fill": 0.25},
         "beam": {"photons_per_s": 1e5}}  # fmt: skip


def of_role(pieces: tuple[Piece, ...], role: str) -> list[Any]:
    return [piece.solid for piece in pieces if piece.role == role]


def test_state_0_is_the_sample_itself_and_so_is_the_last_one_but_for_the_walk() -> None:
    first = CELL.pieces()
    last = replace(Cycle(), walk_um=0, walk_deg=0, healing=1.0, bubble_um=0).at(first, 12.0)
    for pieces in (Cycle().at(first, 0.0), last):
        assert [piece.role for piece in pieces] == [piece.role for piece in first]
        for one, other in zip(pieces, first, strict=True):
            np.testing.assert_allclose(one.solid.centre, other.solid.centre, atol=1e-12)
            assert replace(one.solid, centre=(0, 0, 0)) == replace(other.solid, centre=(0, 0, 0))


def test_volume_and_grey_level_change_so_that_the_mass_stays() -> None:
    first = CELL.pieces()
    for state, charge in ((3.0, 0.5), (6.0, 1.0), (9.0, 0.5)):
        for before, after in zip(of_role(first, "particle"), of_role(STILL.at(first, state), "particle"), strict=True):
            grown = np.prod(after.semi_axes) / np.prod(before.semi_axes)
            assert grown == pytest.approx(1 + 0.04 * charge)
            assert after.attenuation * grown == pytest.approx(before.attenuation)
        cracks = of_role(STILL.at(first, state), "crack")  # of the start: they stay inside their particles
        assert len(cracks) == len(of_role(first, "crack")) > 0


def test_growth_has_its_spread_and_some_particles_are_inactive() -> None:
    table = Cycle(state=6, seed=3).table(Cathode(diameter=0.2, height=0.1, size_um=12, fill=0.3).pieces())
    growth, inactive = table["growth"], table["growth"] == 0
    assert inactive.mean() == pytest.approx(0.1, abs=0.04)
    assert growth[~inactive].mean() == pytest.approx(0.04, abs=1e-3)
    assert growth[~inactive].std() == pytest.approx(0.005, rel=0.15)
    np.testing.assert_allclose(table["grey"] * (1 + growth), 1)


def test_cracks_open_between_half_and_full_charge_and_half_of_them_heal() -> None:
    first = Cathode(diameter=0.2, height=0.1, size_um=12, fill=0.3).pieces()
    widths = [replace(Cycle(seed=5), state=state).table(first)["crack_um"] for state in (3.0, 5.0, 6.0, 9.0)]
    half, before_full, full, after = widths
    assert not half.any() and 0 < (before_full > 0).mean() < (full > 0).mean()
    assert (full > 0).mean() == pytest.approx(0.2, abs=0.05)
    assert full[full > 0].min() >= 0.3 and full.max() <= 1.3
    assert (after > 0).sum() / (full > 0).sum() == pytest.approx(0.5, abs=0.15)
    np.testing.assert_array_equal(after[after > 0], full[after > 0])
    opened = of_role(replace(Cycle(seed=5), bubble_um=0).at(first, 6.0), "crack")
    thin = sorted(2e3 * min(solid.semi_axes) for solid in opened)
    np.testing.assert_allclose(thin, np.sort(full[full > 0]), rtol=1e-9)


def test_the_electrode_swells_along_the_axis_alone() -> None:
    first = CELL.pieces()
    before, after = (np.array([s.centre for s in of_role(pieces, "particle")])
                     for pieces in (first, replace(STILL, swelling=0.03).at(first, 6.0)))  # fmt: skip
    np.testing.assert_array_equal(after[:, :2], before[:, :2])
    bottom = before[:, 2].min()
    np.testing.assert_allclose(after[:, 2] - bottom, 1.03 * (before[:, 2] - bottom))


def test_the_walk_is_rigid_and_its_steps_have_their_size() -> None:
    first, cycle = CELL.pieces(), replace(STILL, walk_um=2.0, walk_deg=1.0, growth=0, states=1000)
    places = [np.array([s.centre for s in of_role(cycle.at(first, state), "particle")]) for state in (1.0, 2.0)]
    apart = [np.linalg.norm(at[:, None] - at, axis=2) for at in places]
    np.testing.assert_allclose(apart[0], apart[1], atol=1e-12)
    moved = [cycle.at(first, float(state)) for state in range(0, 1001, 50)]
    middles = np.array([np.mean([s.centre for s in of_role(each, "wall")], axis=0) for each in moved])
    steps = np.diff(middles[:, 2])  # a turn does not change heights
    assert steps.std() == pytest.approx(2e-3 * np.sqrt(50), rel=0.5)


def test_the_bubble_is_in_the_electrolyte_and_the_same_in_all_states() -> None:
    first, cycle = CELL.pieces(), replace(STILL, bubble_um=30.0, growth=0)
    assert not of_role(cycle.at(first, 0.0), "gas")
    one, other = (of_role(cycle.at(first, state), "gas") for state in (1.0, 6.0))
    assert one == other and isinstance(one[0], Ellipsoid) and 0 < one[0].semi_axes[0] <= 0.015
    centres = np.array([solid.centre for solid in of_role(first, "particle")])
    reach = np.array([max(solid.semi_axes) for solid in of_role(first, "particle")])
    assert (np.linalg.norm(centres - one[0].centre, axis=1) >= reach + one[0].semi_axes[0] - 1e-12).all()


def test_a_scene_has_the_state_that_it_names_and_changes_in_steps() -> None:
    grid = Grid((40, 40, 40), 0.005)

    def seen(seconds: float, **change: float) -> Any:
        scene = SCENE | {"phantom": SCENE["phantom"] | {"change": {"kind": "cycle", **change}}}
        sample = load_scene(scene).sample
        assert isinstance(sample, Changing)
        return sample_at(sample, seconds).attenuation(grid)

    np.testing.assert_array_equal(seen(0.0, state=3), seen(99.0, state=3))
    np.testing.assert_array_equal(seen(25.0, every_s=10.0), seen(0.0, state=2))
    assert np.abs(seen(0.0, state=3) - seen(0.0)).max() > 0


def test_the_table_tells_where_particles_are_in_the_state() -> None:
    scene = SCENE | {"phantom": SCENE["phantom"] | {"change": {"kind": "cycle", "state": 6, "walk_um": 3.0}}}
    sample = load_scene(scene).sample
    assert isinstance(sample, Changing)
    table, grid = sample.table, Grid((64, 80, 80), 0.0025)
    labels = sample.labels(grid)
    inside = sample.names.index("particle") + 1, sample.names.index("crack") + 1
    z, y, x = (np.abs(at[:, None] - table[f"{axis}_mm"]).argmin(0)
               for axis, at in zip("zyx", grid.coordinates(), strict=True))  # fmt: skip
    assert np.isin(labels[z, y, x], inside).mean() > 0.98
    np.testing.assert_array_equal(table["particle"], np.arange(1, len(z) + 1))


test_calls_that_are_refused = refused_calls(__file__, globals())
