"""Errors: each kind has its exit code."""

from __future__ import annotations

import pytest

from beamline.core.errors import ConfigError, InstrumentError, exit_code
from drivers.base.errors import DeviceError


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (InstrumentError("x"), 3),
        (DeviceError("stage", "x"), 3),
        (ConfigError("x"), 2),
        (KeyboardInterrupt(), 130),
        (ZeroDivisionError(), 1),
    ],
)
def test_exit_codes(error: BaseException, code: int) -> None:
    assert exit_code(error) == code
