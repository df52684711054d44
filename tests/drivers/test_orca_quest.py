"""ORCA-Quest figures compared with the vendor's published numbers."""

from __future__ import annotations

import re

import pytest

from drivers import orca_quest
from drivers.base.protocols import CameraSettings, TriggerSource


def _settings(**changes: object) -> CameraSettings:
    return CameraSettings(**({"exposure": 0.01, "trigger": TriggerSource.EXTERNAL} | changes))  # type: ignore[arg-type]


def test_printed_times() -> None:
    standard = orca_quest.timing(_settings(exposure=7.2e-6), "coaxpress")
    assert standard.shape == (2304, 4096)
    assert standard.readout == pytest.approx(8.2944e-3)
    # The shortest exposure under free-running triggers comes within a line or so of the printed 120 frames/s.
    assert 1 / standard.min_period == pytest.approx(120, rel=0.01)
    quiet = orca_quest.timing(_settings(readout="ultra_quiet"), "coaxpress")
    assert quiet.readout == pytest.approx(199.07e-3, abs=1e-5)
    # Rolling shutter: the last row starts one readout (less a row) after the first.
    assert quiet.row_period * 2304 == pytest.approx(quiet.readout)


def test_resolving_photon_numbers_takes_as_long_as_the_ultra_quiet_readout() -> None:
    quiet, resolving = (orca_quest.timing(_settings(readout=name)) for name in ("ultra_quiet", "photon_number"))
    assert resolving == quiet
    assert "outside 0.0001728" in orca_quest.refusal(_settings(readout="photon_number", exposure=1e-4))


def test_usb_limits_full_frames_and_not_small_ones() -> None:
    assert 1 / orca_quest.timing(_settings(exposure=0.001), "usb3").min_period == pytest.approx(17.6996)
    small = _settings(exposure=0.001, roi=(0, 0, 144, 160))
    assert orca_quest.timing(small, "usb3") == orca_quest.timing(small, "coaxpress")
    assert orca_quest.timing(small).min_period == pytest.approx(0.001 + 77 * 7.2e-6)


def test_binning_shrinks_the_frame_and_the_transfer_not_the_readout() -> None:
    whole, binned = (orca_quest.timing(_settings(exposure=0.001, binning=n)) for n in (1, 2))
    assert binned.shape == (1152, 2048)
    assert binned.readout == whole.readout
    assert binned.row_period == 2 * whole.row_period
    assert binned.min_period == pytest.approx(whole.min_period / 4)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"readout": "fast"}, "'fast' is unknown; legal: standard, ultra_quiet, photon_number"),
        ({"binning": 3}, "binning 3 does not exist; legal: 1, 2, 4"),
        ({"exposure": 1e-6}, "outside 7.2e-06"),
        ({"exposure": 1e-4, "readout": "ultra_quiet"}, "outside 0.0001728"),
        ({"exposure": 2000.0}, "1800 s"),
        ({"roi": (0, 0, 142, 160)}, "steps of 4"),
        ({"roi": (2200, 0, 144, 160)}, "2304 x 4096"),
        ({"roi": (0, 0, 0, 160)}, "extends beyond the sensor"),
        ({"roi": (-4, 0, 144, 160)}, "extends beyond the sensor"),
    ],
)
def test_refusals_name_the_legal_values(changes: dict[str, object], problem: str) -> None:
    assert problem in orca_quest.refusal(_settings(**changes))
    with pytest.raises(ValueError, match=re.escape(problem)):
        orca_quest.timing(_settings(**changes))


def test_nothing_to_refuse() -> None:
    assert orca_quest.refusal(_settings(roi=(2160, 3936, 144, 160), binning=4)) == ""


def test_the_second_model_reads_ultra_quiet_at_its_printed_rate() -> None:
    quiet = orca_quest.timing(_settings(exposure=34e-6, readout="ultra_quiet"), "coaxpress", "C15550-22UP")
    assert 1 / quiet.min_period == pytest.approx(25.4, rel=0.005)
    standard = [orca_quest.timing(_settings(), "coaxpress", model) for model in orca_quest.LINE_TIMES]
    assert standard[0] == standard[1]
