"""Options that exclude each other are refused in Python for the reasons of the table that the command line has."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from beamline.core.errors import ConfigError
from beamline.projections.selection import Selection
from beamline.reconstruct.combinations import EXCLUDED, SLABS_RESUMED, contradiction
from beamline.reconstruct.options import FollowTiming, OutputPaths, ReconOptions
from beamline.reconstruct.refusals import refuse_before_reading
from beamline.reconstruct.region import AroundSample
from beamline.storage.readers.open import SourceOptions
from recon import R2, TimeSeries

VALUES: dict[str, dict[str, Any]] = {
    "follow": {"follow": FollowTiming()},
    "budget": {"budget": 30.0},
    "quality": {"quality": "best"},
    "reference": {"reference": Path("good.h5")},
    "volumes": {"method": TimeSeries(volumes=3)},
    "uncertainty": {"uncertainty": True},
    "truth": {"truth": "truth.npy"},
    "roi": {"region": AroundSample()},
    "cluster": {"cluster": "local:2"},
    "memory": {"memory": 10**9},
    SLABS_RESUMED: {"partial": Path("a.partial.h5")},
}
PAIRS = [(a, b, why) for a, others in EXCLUDED.items() for b, why in others.items() if {a, b} <= {*VALUES}]


def options(tmp_path: Path, **given: Any) -> ReconOptions:
    target = OutputPaths(tmp_path / "volume.h5", None)
    return ReconOptions(SourceOptions("no_scan.h5"), target, Selection(), **({"method": R2()} | given))


@pytest.mark.parametrize(("name", "other", "why"), PAIRS)
def test_a_contradiction_is_refused_before_the_scan_is_opened(tmp_path: Path, name: str, other: str, why: str) -> None:
    both = options(tmp_path, **VALUES[name], **VALUES[other])
    assert both.given == {name, other}
    with pytest.raises(ConfigError) as error:
        refuse_before_reading(both)
    assert str(error.value) == f"{name} cannot be combined with {other}: {why}. Nothing was computed."


@pytest.mark.parametrize("name", VALUES)
def test_each_option_alone_contradicts_nothing(tmp_path: Path, name: str) -> None:
    assert contradiction(options(tmp_path, **VALUES[name]).given) is None
