"""What the first users' league measures with: scenes of exact chords, the search for cracks, sweeps, kept scores."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from recon.base.geometry import Geometry
from tests.bench import first_users
from tests.bench.first_users import Cell, Kept, Score, climb, cracks_found, judged, noisy, play_all, tables
from tests.bench.first_users_scenes import SCENES, Bodies, Scene, _add_view, _cracked, _fill, packed_bodies

COLS, ROWS, VIEWS = 128, 8, 6
CELL = Cell("packed", 512, 90, 1.0, 1e4, 1)


@pytest.fixture(scope="module")
def cracked() -> Scene:
    return SCENES["cracks"](COLS, ROWS, 1.0, Geometry.parallel(np.arange(VIEWS) * np.pi / VIEWS, (ROWS, COLS)))


def test_bodies_do_not_meet_and_fill_two_fifths() -> None:
    can, half = 40.0, 20.0
    bodies = packed_bodies(np.random.default_rng(3), can, half)
    is_ball = np.isinf(bodies.plate[:, 4])
    own = np.where(is_ball, 4 / 3, 2 * (0.25 - 0.25**3 / 3)) * np.pi * bodies.radius**3
    assert own.sum() / (np.pi * can**2 * 2 * half) == pytest.approx(0.4, abs=0.04) and not is_ball.all()
    assert (np.hypot(*bodies.centre[is_ball, :2].T) + bodies.radius[is_ball] < can).all()
    x, z = (np.arange(n) - (n - 1) / 2 for n in (80, 40))
    filled = np.zeros((40, 80, 80), np.float32)
    _fill(bodies._replace(density=np.ones(len(own))), x, z, 4, filled)
    assert filled.max() <= 1


@pytest.mark.parametrize(("half", "off", "width"), [(np.inf, 0.0, 0.0), (2.5, 0.0, 0.0), (np.inf, 2.0, 1.6)])
def test_a_view_is_the_sum_of_finely_divided_matter(half: float, off: float, width: float) -> None:
    """Of a ball, a plate and a ball with a crack."""
    normal = np.array([0.6, 0.48, 0.64])
    plate, crack = np.array([[*normal, 0.0, half]]), np.array([[*normal, off, width / 2]])
    body = Bodies(np.array([[1.3, -2.1, 0.4]]), np.array([9.0]), np.array([0.7]), plate, crack)
    u = (np.arange(30 * 8) + 0.5) / 8 - 15
    lines = np.zeros((u.size, u.size))
    _add_view(body, 0.0, u, u, lines)  # along y
    fine = np.zeros((30, 30, 30), np.float32)
    _fill(body, np.arange(30) - 14.5, np.arange(30) - 14.5, 8, fine)
    np.testing.assert_allclose(lines.reshape(30, 8, 30, 8).mean((1, 3)), fine.sum(1), atol=0.05)
    turned = np.zeros_like(lines)
    _add_view(body, 1.1, u, u, turned)
    assert turned.sum() == pytest.approx(lines.sum(), rel=1e-3)


@pytest.mark.parametrize("name", SCENES)
def test_every_view_of_a_sample_in_the_field_shows_all_its_matter(name: str) -> None:
    scene = SCENES[name](COLS, ROWS, 1.0, Geometry.parallel([0.0, 0.9], (ROWS, COLS)))
    mass = scene.truth.sum((1, 2))
    tolerance = 0.05 if name == "fringes" else 5e-3  # fringes move light from row to row
    np.testing.assert_allclose(scene.clean.sum(2), np.stack((mass, mass)), rtol=tolerance)


def test_a_wide_sample_goes_on_outside_the_field() -> None:
    scene = SCENES["packed"](48, ROWS, 1.5, Geometry.parallel([0.0, 0.9], (ROWS, 48)))
    assert (scene.clean.sum(2) > 1.3 * scene.truth.sum((1, 2))).all() and scene.inner > 24
    assert scene.clean[..., 0].min() > 0


def test_cracks_are_found_in_the_truth_and_not_in_noise(cracked: Scene) -> None:
    assert cracked.planes is not None
    assert cracks_found(cracked.truth, cracked.planes) > 0.9
    noise = np.random.default_rng(0).normal(size=cracked.truth.shape).astype(np.float32)
    assert cracks_found(noise, cracked.planes) < 0.2
    bodies = packed_bodies(np.random.default_rng(1), 60.0, 20.0)
    with_cracks, planes = _cracked(np.random.default_rng(1), bodies)
    assert (with_cracks.crack[:, 4] > 0).sum() == (planes.width > 0).sum() > 5


def test_the_judge_knows_quality_and_the_fraction_of_grains(cracked: Scene) -> None:
    rows = range(ROWS)
    quality, fraction, found = judged(0.999 * cracked.truth, cracked, rows)
    assert quality > judged(0.99 * cracked.truth, cracked, rows)[0] + 19
    assert fraction == pytest.approx(1, abs=0.02) and found is not None
    assert judged(np.full_like(cracked.truth, cracked.levels[0]), cracked, rows)[1] == 0
    assert judged(0.9 * cracked.truth[:2], cracked, [0, 1])[2] is None


def test_seeds_change_the_noise_alone(cracked: Scene) -> None:
    one, other = (noisy(CELL._replace(seed=seed), cracked) - cracked.clean for seed in (1, 2))
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.05
    assert np.std(one * np.exp(-cracked.clean / 2)) == pytest.approx(0.01, rel=0.05)


@pytest.mark.parametrize("top", [-3, -1, 0, 2])
def test_a_sweep_ends_when_it_has_seen_less_on_both_sides(top: int) -> None:
    seen: list[int] = []

    def quality(k: int) -> float:
        seen.append(k)
        return -abs(k - top)

    assert climb(quality, lambda k: k) == top
    assert {top - 1, top, top + 1} <= set(seen) and len(seen) <= abs(top) + 4


def test_a_second_call_goes_on_and_a_best_setting_is_swept_by_the_first_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[tuple[int, object]] = []

    def play(cell: Cell, name: str, value: float | None, limit: float) -> Score:
        made.append((cell.seed, value))
        return Score(20.0 - abs(math.log2((value or 0.025) / 0.002)), 1.0, None, 3.0, 100.0)

    monkeypatch.setattr(first_users, "play", play)
    cells, path = [CELL, CELL._replace(seed=2)], tmp_path / "scores.json"
    play_all(Kept(path), cells, ["fista-tv"], True, 10.0)
    assert made == [(1, None), (1, 1e-3), (1, 2e-3), (1, 4e-3), (2, None), (2, 2e-3)]
    kept = Kept(path)
    play_all(kept, cells, ["fista-tv"], True, 10.0)
    assert len(made) == 6
    assert tables(kept, cells).splitlines()[4:] == [
        "| fista-tv | 16.36 (16.36 to 16.36), 1.00, 3 s | 100 |",
        "| fista-tv, best | 20.00 (20.00 to 20.00), 1.00, 3 s (weight 0.002) | 100 |",
    ]


def test_what_was_ended_is_made_again_only_with_a_higher_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[float] = []

    def play(cell: Cell, name: str, value: float | None, limit: float) -> Score:
        made.append(limit)
        return Score(None, None, None, limit, 0.0)

    monkeypatch.setattr(first_users, "play", play)
    kept = Kept(tmp_path / "scores.json")
    for limit in (10.0, 10.0, 20.0):
        play_all(kept, [CELL], ["fbp"], False, limit)
    assert made == [10.0, 20.0] and "ended at 20 s" in tables(kept, [CELL])


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "does not hold scores"),
        (json.dumps({"version": 0, "first_users": {}}), "has scores of version 0"),
        (json.dumps({"version": 1, "first_users": {f"{CELL}|fbp|default": [1.0, 1.0, None, 1.0]}}), "is damaged"),
        (json.dumps({"version": 1, "first_users": {"bone|fbp": [1.0, 1.0, None, 1.0, 1.0]}}), "is damaged"),
    ],
)
def test_scores_of_another_version_or_damaged_ones_are_refused(tmp_path: Path, content: str, sentence: str) -> None:
    path = tmp_path / "scores.json"
    path.write_text(content)
    with pytest.raises(SystemExit, match=sentence):
        first_users.main([str(path), "--table"])
    assert path.read_text() == content


def test_two_who_add_to_one_file_keep_each_other_s_scores(tmp_path: Path) -> None:
    one, other = Kept(tmp_path / "scores.json"), Kept(tmp_path / "scores.json")
    score = Score(1.0, 1.0, None, 1.0, 1.0)
    one.change(lambda scores: scores | {f"{CELL}|fbp|default": score})
    other.change(lambda scores: scores | {f"{CELL}|auto|default": score})
    assert len(Kept(tmp_path / "scores.json").scores) == 2
