"""Conformance tests for drivers of cameras and stages: pytest classes from which the tests of a driver derive.

They need pytest, and do not import simulators or beamline.
"""

import pytest

pytest.register_assert_rewrite("drivers.testing.camera", "drivers.testing.stages")
