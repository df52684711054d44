"""Conformance suites: the laws for every driver of a camera or a stage, as pytest classes that its tests subclass.

They need pytest, and import neither simulators nor beamline.
"""

import pytest

pytest.register_assert_rewrite("drivers.testing.camera", "drivers.testing.stages")
