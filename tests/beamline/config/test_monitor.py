"""Section monitor: every limit of every check is a key with a type, a range and a default, and nothing else is."""

import pytest

from beamline.config.load import config_folder, load
from beamline.config.monitor import configured_checks, policies
from beamline.core.errors import ConfigError
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


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("monitor.beam.drift=-0.1", r"monitor\.beam\.drift is -0\.1; expected a number >= 0"),
        ("monitor.beam.drift=much", r"monitor\.beam\.drift is 'much'; expected a number >= 0"),
        ("monitor.beam.drift=.nan", r"monitor\.beam\.drift is \.nan; expected a number >= 0"),
        ("monitor.mass.frames=2.5", r"monitor\.mass\.frames is 2\.5; expected a whole number >= 1"),
        (
            "monitor.beam.drfit=0.1",
            r"is not a known key \(did you mean drift\?\); legal keys there: drift, dip",
        ),
        (
            "monitor.bean={drift: 0.1}",
            r"monitor\.bean is not .*beam.*legal keys there: act_after, retake, retake_share, policy",
        ),
        ("monitor.timing=0.3", r"monitor\.timing is 0\.3; expected a group of keys: warn"),
        ("monitor.policy.beam=halt", r"monitor\.policy\.beam is 'halt'; expected log \| warn \| pause \| stop"),
    ],
)
def test_a_limit_that_cannot_be_is_refused_with_the_legal_ones(word: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^--set {word.split('=')[0]}.*{message}"):
        load(config_folder() / "demo.yaml", [word], {})


def test_each_check_has_a_policy_and_by_default_its_own() -> None:
    read = policies(load(config_folder() / "demo.yaml", ["monitor.policy.beam=pause"], {}).monitor)
    assert read == {check.name: check.policy for check in CHECKS} | {"beam": Policy.PAUSE}
