"""Clusters of grey values: the best ones found by trying all, the elbow, the threshold."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.post import clusters, elbow, k_means


@given(st.lists(st.floats(-100, 100), min_size=6, max_size=14, unique=True), st.integers(2, 3))
def test_centres_are_nearly_the_best_of_all_partitions(values: list[float], k: int) -> None:
    ordered = np.sort(values)

    def misfit(cuts: tuple[int, ...]) -> float:
        return sum(float(part.var() * part.size) for part in np.split(ordered, cuts))

    best = min(misfit(cuts) for cuts in itertools.combinations(range(1, len(values)), k - 1))
    centres = k_means(np.array(values), k)
    found = float((np.abs(ordered[:, None] - centres).min(axis=1) ** 2).sum())
    assert best * (1 - 1e-9) - 1e-9 <= found <= 1.5 * best + 1e-9
    assert (np.diff(centres) > 0).all()


@pytest.mark.parametrize("k", [2, 3, 4, 5])
def test_the_elbow_is_at_the_number_of_materials(rng: np.random.Generator, k: int) -> None:
    values = np.concatenate([rng.normal(level, 0.05, 3000) for level in range(k)])
    found = clusters(values)
    assert found.centres == pytest.approx(range(k), abs=0.02)
    assert found.shares == pytest.approx(np.full(k, 1 / k), abs=0.01)


def test_the_elbow_is_where_further_clusters_gain_little() -> None:
    assert elbow(np.array([1.0, 0.5, 0.1, 0.08, 0.06, 0.04])) == 3
    assert elbow(np.array([1.0, 0.0])) == elbow(np.array([1.0, 0.1, 0.08])) == 2
    assert clusters(np.array([0.0, 1.0, 1.0, 0.0])).centres.tolist() == [0.0, 1.0]


def test_the_threshold_is_half_way_between_the_brightest_and_the_largest_other(rng: np.random.Generator) -> None:
    edges, matrix, particles = rng.normal(0.6, 0.01, 300), rng.normal(0.2, 0.01, 5000), rng.normal(1.0, 0.01, 800)
    assert clusters(np.concatenate((edges, matrix, particles)), 3).threshold == pytest.approx(0.6, abs=0.01)


@pytest.mark.parametrize(
    ("values", "k", "said"), [([1.0, 1.0], 2, "different"), ([1.0, 2.0], 1, "at least 2"), ([1.0, np.nan], 2, "finite")]
)
def test_what_makes_no_clusters_is_refused(values: list[float], k: int, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        clusters(np.array(values), k)
