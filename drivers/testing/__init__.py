"""Conformance suites: what every driver of a camera or a stage does, as pytest classes that a driver's tests subclass.

They need pytest, and import neither simulators nor beamline.
"""

import pytest

pytest.register_assert_rewrite("drivers.testing.camera", "drivers.testing.stages")
