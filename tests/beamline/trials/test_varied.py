"""What a trade-off varies of each method: settings that it has, and a colour of its own."""

from __future__ import annotations

import pytest

from beamline.trials import varied
from beamline.trials.varied import Depth, colour_of, trials_of, work_of
from recon import methods


@pytest.mark.parametrize("name", methods.names())
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


def test_every_method_has_a_colour_of_its_own_also_one_of_another_package(monkeypatch: pytest.MonkeyPatch) -> None:
    names = (*methods.names(), "theirs", "others")
    monkeypatch.setattr(varied, "names", lambda: names)
    assert len({colour_of(name) for name in names}) == len(names)
    assert [tried.settings for tried in trials_of("theirs", 5000, "full")] == [{}]
