"""What a trade-off varies of each method: settings that it has."""

from __future__ import annotations

import pytest

from beamline.features.trials.tradeoff import Depth, trials_of
from recon import methods


@pytest.mark.parametrize("name", methods.names_of_one_volume())
@pytest.mark.parametrize("depth", ["quick", "full"])
def test_every_trial_is_settings_that_the_method_has(name: str, depth: Depth) -> None:
    method = methods.by_name(name)
    base, *others = trials_of(name, 60, 5000, depth)
    assert base.group == "method" and base.binning == 1
    for tried in (base, *others):
        assert isinstance(tried.build(), method)
