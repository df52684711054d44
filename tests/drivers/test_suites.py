"""The conformance suites of all packages: a subclass without a fixture gets a message that says what to define."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

LACKING = """
from beamline.testing import ReaderConformance
from drivers.testing.camera import CameraConformance
from drivers.testing.stages import StageConformance
from recon.testing import MethodConformance

class TestReader(ReaderConformance): pass
class TestCamera(CameraConformance): pass
class TestStage(StageConformance): pass
class TestMethod(MethodConformance): pass
"""


def test_a_class_without_its_fixtures_fails_with_a_sentence_and_no_test_is_skipped(pytester: pytest.Pytester) -> None:
    pytester.makeini("[pytest]\nmarkers =\n    slow: takes seconds")
    pytester.makepyfile(LACKING)
    result = pytester.runpytest_inprocess("-q", "-p", "no:cacheprovider", "--tb=line")
    outcomes = result.parseoutcomes()
    assert set(outcomes) <= {"error", "errors", "failed"}
    for fixture in ("path", "bench", "kind"):
        result.stdout.fnmatch_lines([f"*the fixture `{fixture}`*: *"])
    result.stdout.fnmatch_lines(["*Define the fixture `method` in your subclass: *"])


def test_no_suite_skips_a_test() -> None:
    root = Path(__file__).parents[2]
    suites = [
        *(root / "drivers/testing").rglob("*.py"),
        root / "recon/testing/__init__.py",
        root / "beamline/testing/__init__.py",
    ]
    assert [path.name for path in suites if "skip" in path.read_text(encoding="utf-8")] == []
