"""The decision rule, on given residuals, and the search for a regularisation weight."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from recon.base.decisions import MaterialPrior, Prior
from recon.voxels.choice import (
    Prediction,
    TrialChoice,
    exceeds_standard_error,
    preferred_strength,
)


def simplest_within_one_se(residuals: Sequence[NDArray[np.float64] | None], least_gain: float = 0.02) -> int | None:
    """Number of the candidate that a choice takes."""
    given = (Prediction("", None if each is None else each.tolist()) for each in residuals)
    return TrialChoice("", least_gain, tuple(given)).chosen


SCATTER = np.array([-0.3, 0.1, 0.4, -0.2, 0.0])  # of views, which all candidates share


@given(arrays(np.float64, 6, elements=st.floats(-1.0, 1.0)), st.floats(0.1, 10.0))
def test_beyond_chance_is_more_than_a_standard_error_in_any_unit(gains: NDArray[np.float64], unit: float) -> None:
    error = float(gains.std(ddof=1)) / math.sqrt(6)
    assume(abs(gains.mean() - error) > 1e-6)
    assert exceeds_standard_error(unit * gains, 1.0) == (gains.mean() > error)
    assert not exceeds_standard_error(np.append(gains, np.inf), 1.0)  # the other candidate was ended


@pytest.mark.parametrize(
    ("means", "least_gain", "taken"),
    [
        ((1.5, 1.2, 1.0), 0.02, 2),
        ((1.5, 1.015, 1.0), 0.02, 1),  # ahead by less than that
        ((1.5, 1.015, 1.0), 0.0, 2),
        ((1.5, 1.015, None), 0.02, 1),
        ((None, None, 1.0), 0.02, 2),
        ((1.0, 1.2, 0.5), 0.6, 0),
        ((None, None), 0.02, None),
    ],
)
def test_the_cheapest_candidate_that_the_best_does_not_lead_is_taken(
    means: tuple[float | None, ...], least_gain: float, taken: int | None
) -> None:
    residuals = [None if mean is None else mean + SCATTER for mean in means]
    assert simplest_within_one_se(residuals, least_gain) == taken


def test_a_lead_by_chance_is_none() -> None:
    assert simplest_within_one_se([1 + SCATTER, 0.9 - SCATTER], 0.0) == 0  # differs by 0.06 to 1.1 from view to view


@pytest.mark.parametrize("ended", [np.full(5, np.inf), np.full(1, np.inf), np.full(5, np.nan)])
def test_a_trial_that_was_ended_or_diverged_is_not_taken(ended: NDArray[np.float64]) -> None:
    """As FBP where the time of trials ends in the search for the strength of patches."""
    assert simplest_within_one_se([ended, 2 + SCATTER, ended, 1 + SCATTER, ended]) == 3
    assert simplest_within_one_se([ended, 1 + SCATTER]) == 1
    assert simplest_within_one_se([ended]) is None


@pytest.mark.parametrize("best", [-5, -1.3, 0, 0.4, 1, 2, 7])
def test_the_strength_of_the_least_residual_is_found(best: float) -> None:
    """A residual that is a parabola of the octave has its vertex where a parabola through three points has it."""
    found = preferred_strength(lambda strength: 1 + (math.log2(strength / 3) - best) ** 2 + SCATTER, 3.0)
    assert found is not None and found.strength == pytest.approx(3.0 * 2.0**best)
    np.testing.assert_allclose(found.residuals, 1 + (round(best) - best) ** 2 + SCATTER)


def test_from_strengths_that_change_nothing_the_search_goes_on_to_stronger_ones() -> None:
    """As of a measured walnut of 25 views: level over three octaves, with a rise of 0.02 % each; then it falls."""
    by_view = np.array([-1.0, 1.0, -1.0, 1.0, 0.0])

    def residuals(strength: float) -> NDArray[np.float64]:
        octave = math.log2(strength / 3)
        mean = 1.08 + 0.0002 * octave if octave < 3 else 1 + abs(octave - 5) / 100
        return mean + SCATTER + 0.01 * octave * by_view

    found = preferred_strength(residuals, 3.0)
    assert found is not None and found.strength == pytest.approx(3 * 32)


def test_trials_that_were_ended_prefer_nothing() -> None:
    assert preferred_strength(lambda _: np.full(5, np.inf), 3.0) is None


@pytest.mark.parametrize(
    ("gain", "scatter", "costs_little", "least_gain", "taken"),
    [
        (0.008, 0.001, True, 0.02, "pnp"),
        (0.008, 0.001, False, 0.02, "tv"),  # as a Gaussian fit, which takes several times as long
        (0.004, 0.0001, True, 0.02, "tv"),  # less than a quarter of 2 %
        (0.018, 0.02, True, 0.02, "tv"),  # 2.1 standard errors
        (0.018, 0.0001, True, 0.1, "tv"),  # less than a quarter of 10 %
        (0.018, 0.02, True, 0.0, "pnp"),
    ],
)
def test_a_small_but_certain_gain_suffices_for_a_candidate_that_costs_little(
    gain: float, scatter: float, costs_little: bool, least_gain: float, taken: str
) -> None:
    by_view = scatter * np.array([-1.0, 1.0, -1.0, 1.0, 0.0])  # standard error of the mean: scatter / √5
    choice = TrialChoice("16 rows", least_gain).after(Prediction("tv", (1 + SCATTER).tolist(), Prior(1.0)))
    choice = choice.after(Prediction("pnp", (1 - gain + by_view + SCATTER).tolist(), costs_little=costs_little))
    assert choice.chosen is not None and choice.predictions[choice.chosen].name == taken
    certain = "or by 0.5% and by more than 4 standard errors"
    assert (certain in choice.reason) is (taken == "tv" and costs_little and least_gain == 0.02)


def test_a_certain_gain_is_one_over_a_candidate_with_a_prior_in_enough_projections() -> None:
    def chosen(views: int, **means: float) -> str:
        choice, scatter = TrialChoice("16 rows"), SCATTER[:views]
        for name, mean in means.items():
            prior = None if name == "fbp" else Prior(1.0)
            choice = choice.after(Prediction(name, (mean + scatter).tolist(), prior, costs_little=name == "pnp"))
        assert choice.chosen is not None
        if choice.predictions[choice.chosen].name == "pnp" and means.get("tv"):
            certain = (
                "pnp is 1.00% smaller than the residual of tv (standard error 0.00%). Here a gain below 2% suffices"
            )
            assert (certain in choice.reason) is (means["pnp"] == 0.99)
        return choice.predictions[choice.chosen].name

    assert chosen(5, tv=1, pnp=0.99) == "pnp"
    assert chosen(4, tv=1, pnp=0.99) == "tv"
    assert chosen(1, tv=1, pnp=0.99) == "tv"
    assert chosen(5, fbp=1, pnp=0.99) == chosen(5, fbp=1, tv=0.991, pnp=0.99) == "fbp"
    assert chosen(5, tv=1, pnp=0.99, r2=0.985) == "pnp"
    assert chosen(5, tv=1, pnp=0.99, r2=0.9) == "r2"
    assert chosen(5, tv=1, pnp=0.97) == "pnp"


def test_a_choice_names_the_best_and_what_chance_does_not_tell_from_it() -> None:
    def verdicts(*residuals: NDArray[np.float64], least_gain: float = 0.0) -> list[str]:
        given = (Prediction("", each.tolist()) for each in residuals)
        return TrialChoice("", least_gain, tuple(given)).verdicts

    ended = np.full(5, np.inf)
    assert verdicts(1.2 + SCATTER, 1 + SCATTER, 1.01 - SCATTER, ended) == ["", "best", "alike", ""]
    assert verdicts(1.04 + SCATTER, 1 + SCATTER, least_gain=0.05) == ["", ""]  # the best lowers none by so much
    assert verdicts(ended) == [""]


def test_the_reason_of_a_certain_gain_names_the_candidate_that_was_replaced_not_the_levels() -> None:
    """As of the fine structure of bone: patches predict hardly better than levels."""
    levels = Prior(1.0, materials=MaterialPrior((0.0, 1.0), (0.5, 0.5), 1.0, 0.02, 0.1))
    choice = TrialChoice("16 rows").after(Prediction("tv", (1 + SCATTER).tolist(), Prior(1.0)))
    choice = choice.after(Prediction("discrete", (0.985 + SCATTER).tolist(), levels))
    choice = choice.after(Prediction("pnp", (0.984 + SCATTER).tolist(), Prior(1.0), costs_little=True))
    assert choice.chosen == 2 and "1.60% smaller than the residual of tv" in choice.reason
    few = choice._replace(
        predictions=tuple(each._replace(residuals=(each.residuals or ())[:4]) for each in choice.predictions)
    )
    assert few.chosen == 1 and "4 standard errors" not in few.reason


def test_a_choice_says_why_the_lowest_residual_is_not_taken() -> None:
    def reason(gain: float, least_gain: float, scatter: NDArray[np.float64] = 0 * SCATTER) -> str:
        given = (Prediction(name, left.tolist()) for name, left in (("tv", 1 + scatter), ("r2", 1 - gain - scatter)))
        return TrialChoice("16 rows", least_gain, tuple(given)).reason

    small = reason(0.004, 0.02)
    assert (
        "tv 1.000; r2 0.9960. The residual of r2 is 0.40% smaller than the residual of tv (standard error 0.00%). tv "
        "was chosen" in small
    )
    assert small.endswith("only if its residual is smaller by 2% and by more than one standard error")
    by_chance = reason(1e-5, 0.0, SCATTER)
    assert "tv was chosen" in by_chance and by_chance.endswith("is smaller by more than one standard error")
    assert reason(0.1, 0.02).endswith("tv 1.000; r2 0.9000")


@pytest.mark.parametrize(
    ("discrete", "patches", "taken", "suffice"),
    [(0.99, None, "discrete", False), (0.99, 0.985, "discrete", False), (0.99, 0.975, "pnp-dct", False),
     (0.99, 0.95, "pnp-dct", False), (0.95, None, "discrete", True)],
)  # fmt: skip
def test_levels_that_passed_their_tests_are_taken_even_if_they_gain_little(
    discrete: float, patches: float | None, taken: str, suffice: bool
) -> None:
    levels = Prior(1.0, materials=MaterialPrior((0.0, 1.0), (0.5, 0.5), 1.0, 0.02, 0.1))
    choice = TrialChoice("16 rows").after(Prediction("fbp", (3 + SCATTER).tolist()))
    choice = choice.after(Prediction("fista-tv", (1 + SCATTER).tolist(), Prior(1.0)))
    choice = choice.after(Prediction("discrete", (discrete + SCATTER).tolist(), levels))
    assert choice.levels_suffice() is suffice
    choice = choice.after(Prediction("pnp-dct", None if patches is None else (patches + SCATTER).tolist()))
    assert choice.chosen is not None and choice.predictions[choice.chosen].name == taken
    without = choice._replace(predictions=(*choice.predictions[:2], choice.predictions[2]._replace(prior=None)))
    assert without.chosen == (2 if suffice else 1) and not without.levels_suffice()


@pytest.mark.parametrize(
    ("scatter", "patches", "patch_scatter", "taken"),
    [
        (0.01, None, 0.0, "discrete"),  # the gain of the levels is 18 standard errors
        (0.1, 0.95, 0.001, "pnp-dct"),  # of the levels 1.8 standard errors, of the patches 89
        (0.1, 0.95, 0.05, "discrete"),  # of the patches 1.8 standard errors
        (0.1, 0.985, 0.001, "discrete"),  # of the patches less than 2 %
        (0.1, 0.90, 0.15, "discrete"),  # of the patches 1.2 standard errors
    ],
)
def test_levels_with_an_uncertain_gain_give_way_to_patches_with_a_certain_one(
    scatter: float, patches: float | None, patch_scatter: float, taken: str
) -> None:
    levels = Prior(1.0, materials=MaterialPrior((0.0, 1.0), (0.5, 0.5), 1.0, 0.02, 0.1))
    by_view = np.array([-1.0, 1.0, -1.0, 1.0, 0.0])  # standard error of the mean: 1/√5
    choice = TrialChoice("16 rows").after(Prediction("fista-tv", (1 + SCATTER).tolist(), Prior(1.0)))
    choice = choice.after(Prediction("discrete", (0.92 + scatter * by_view + SCATTER).tolist(), levels))
    assert choice.levels_suffice() and choice.levels_suffice(costs_little=True) is (patches is None)
    residuals = None if patches is None else (patches + patch_scatter * by_view + SCATTER).tolist()
    choice = choice.after(Prediction("pnp-dct", residuals, Prior(1.0), costs_little=True))
    choice = choice.after(Prediction("r2"))
    assert choice.chosen is not None and choice.predictions[choice.chosen].name == taken
    because = "pnp-dct was chosen, because only its gain exceeds 4 standard errors"
    assert choice.reason.endswith(because) is (taken == "pnp-dct")
    assert "costlier" not in choice.reason or taken == "discrete"


def test_patches_replace_levels_only_by_a_clear_gain() -> None:
    """As of a cathode from 90 projections: the levels are better by 1.2 dB."""
    levels = Prior(1.0, materials=MaterialPrior((0.0, 1.0), (0.5, 0.5), 1.0, 0.02, 0.1))
    choice = TrialChoice("16 rows", 0.02).after(Prediction("fista-tv", (1 + SCATTER).tolist(), Prior(1.0)))
    choice = choice.after(Prediction("discrete", (0.97 + SCATTER).tolist(), levels))
    for patches, taken in ((0.96, "discrete"), (0.94, "pnp-dct")):
        both = choice.after(Prediction("pnp-dct", (patches + SCATTER).tolist(), Prior(1.0), costs_little=True))
        assert both.chosen is not None and both.predictions[both.chosen].name == taken


def test_levels_do_not_take_the_place_of_a_candidate_that_predicts_better() -> None:
    levels = Prior(1.0, materials=MaterialPrior((0.0, 1.0), (0.5, 0.5), 1.0, 0.02, 0.1))
    means = {"fbp": 0.9, "fista-tv": 1.2, "discrete": 1.1, "r2": 1.0}
    choice = TrialChoice("16 rows")
    for name, mean in means.items():
        prior = levels if name == "discrete" else None
        choice = choice.after(Prediction(name, (mean + SCATTER).tolist(), prior))
    assert choice.chosen == choice.best == 0


def test_a_choice_is_the_same_from_a_file() -> None:
    """Other slabs of a volume follow that of the first one."""
    choice = TrialChoice("16 rows", 0.02)
    for prediction in (
        Prediction("fbp", remark="fbp: not these"),
        Prediction("fista-tv", (2 + SCATTER).tolist(), Prior(0.1)),
        Prediction("r2", (1 + SCATTER).tolist(), None, "r2 stopped"),
    ):
        choice = choice.after(prediction)
    assert (choice.chosen, choice.prior) == (2, None)
    assert choice.reason.startswith(
        "test reconstructions of 16 rows, root mean square residual in held-out projections"
    )
    assert choice.reason.endswith("fista-tv 2.000; r2 1.000; fbp: not these; r2 stopped")
    again = TrialChoice.of(json.loads(json.dumps(choice)))
    assert (again.chosen, again.reason) == (choice.chosen, choice.reason)
    assert again.predictions == choice.predictions
    assert again.best_residuals is not None and again.best_residuals.mean() == pytest.approx(1.0)
    assert TrialChoice("no views").chosen is None and TrialChoice("no views").reason == "no views"
