"""What a trade-off varies of each method: settings that it has."""

from __future__ import annotations

import pytest

from beamline.features.trials.plans import Depth, trials_of, work_of
from recon import methods


@pytest.mark.parametrize("name", methods.names_of_one_volume())
@pytest.mark.parametrize("depth", ["quick", "full"])
def test_every_trial_is_settings_that_the_method_has(name: str, depth: Depth) -> None:
    method = methods.by_name(name)
    base, *others = trials_of(name, 5000, depth)
    assert base.varies == "method" and base.binning == 1
    for tried in (base, *others):
        built = methods.build(method, tried.settings)
        assert isinstance(built, method) and work_of(built, 60, tried.binning) > 0
    toy, whole = methods.build(method, base.settings).toy(), methods.build(method, base.settings)
    assert work_of(toy, 60, 1) <= work_of(whole, 60, 1)
