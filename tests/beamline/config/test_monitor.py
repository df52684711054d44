"""Section monitor: every limit of every check is a key with type, range and default, and there are no other keys."""

import pytest

from beamline.config.load import config_folder, load
from beamline.config.monitor import configured_checks, policies
from beamline.monitor.beam import BeamCheck
from beamline.monitor.check import Policy
from beamline.monitor.checks import CHECKS
from beamline.monitor.field import MassCheck


@pytest.mark.parametrize("name", ["demo", "simulated", "instrument"])
def test_the_shipped_files_have_the_defaults_of_the_checks(name: str) -> None:
    assert configured_checks(load(config_folder() / f"{name}.yaml", (), {}).monitor) == CHECKS


def test_limits_reach_their_check_and_no_other() -> None:
    words = ["monitor.beam.drift=0.08", "monitor.mass={frames: 5}"]
    changed = {"beam": BeamCheck(drift=0.08), "mass": MassCheck(frames=5)}
    expected = [changed.get(check.name, check) for check in CHECKS]
    assert list(configured_checks(load(config_folder() / "demo.yaml", words, {}).monitor)) == expected


def test_each_check_has_a_policy_and_by_default_its_own() -> None:
    read = policies(load(config_folder() / "demo.yaml", ["monitor.policy.beam=pause"], {}).monitor)
    assert read == {check.name: check.policy for check in CHECKS} | {"beam": Policy.PAUSE}
