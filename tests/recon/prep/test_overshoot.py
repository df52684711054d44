"""Overshoot: phase fringes are found at outer edges; blur, noise, rings and truncated samples are not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from recon.prep.overshoot import Overshoot
from tests.recon.prep.rims import views_of_can


@pytest.mark.parametrize(
    "change", [{}, {"gains": 0.01}, {"noise": 0.03}, {"blur": 0.3}, {"shape": (48, 4, 80)}, {"shape": (1, 8, 80)}]
)
@pytest.mark.parametrize("square", [0.4, 2.0])
def test_fringes_are_seen(square: float, change: dict[str, Any]) -> None:
    seen = Overshoot.of(views_of_can(square, **change)[0])
    assert seen.certain and "lower than in air" in seen.in_words()
    assert seen.share > 0.02


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"noise": 0.0},
        {"noise": 0.1},
        {"noise": 0.01, "gains": 0.03},
        {"blur": 0.5},
        {"blur": 2.0},
        {"over": 1.5, "fringes": 1.0},
        {"shape": (48, 1, 80), "fringes": 1.0},
        {"shape": (48, 8, 20), "fringes": 1.0},
    ],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_nothing_else_is_taken_for_them(seed: int, change: dict[str, Any]) -> None:
    assert not Overshoot.of(views_of_can(seed=seed, **change)[0]).certain


def test_a_blur_as_wide_as_the_fringes_hides_them() -> None:
    """A Gaussian of sigma² = 2 length² undoes them to first order; a filter would blur such views once more."""
    assert not Overshoot.of(views_of_can(0.5, blur=1.3)[0]).certain


def test_the_mirror_image_says_the_same() -> None:
    views, _ = views_of_can(0.5)
    one, other = Overshoot.of(views), Overshoot.of(np.ascontiguousarray(views[:, :, ::-1]))
    assert one.share == pytest.approx(other.share, rel=1e-5) and one.errors == pytest.approx(other.errors, rel=1e-3)
