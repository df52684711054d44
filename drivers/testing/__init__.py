"""Conformance tests for drivers of cameras and stages, as pytest classes that the tests of a driver subclass.

They need pytest, and import neither simulators nor beamline.
"""

import pytest

pytest.register_assert_rewrite("drivers.testing.camera", "drivers.testing.stages")
