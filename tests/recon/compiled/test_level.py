"""The level of x86-64 that numba compiles for."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from beamline.core.process import with_our_path
from recon.compiled import BASELINE, LEVELS, V3, V4, level_for, processor_flags

ZEN_2 = V3.flags | {"sha_ni", "sse4a"}


def test_a_processor_gets_the_highest_level_that_it_has() -> None:
    assert level_for({}, V4.flags | {"avx512_vnni"}) is V4
    assert level_for({}, ZEN_2) is V3
    assert level_for({}, V4.flags - {"avx512vl"}) is V3
    assert level_for({}, frozenset({"sse4_2"})) is None


@pytest.mark.parametrize("own", [{"NUMBA_CPU_NAME": "znver4"}, {"NUMBA_CPU_FEATURES": ""}, {"NUMBA_CPU_NAME": V3.name}])
def test_the_users_own_processor_stands(own: dict[str, str]) -> None:
    assert level_for(own, V4.flags) is None


def test_an_inherited_level_is_kept_where_the_processor_has_it() -> None:
    assert level_for(V3.environment, V4.flags) is V3
    assert level_for(V4.environment, ZEN_2) is V3
    assert level_for(V4.environment, frozenset()) is BASELINE


def test_features_say_what_the_flags_say() -> None:
    """LLVM names some otherwise than Linux."""
    other = {"abm": "lzcnt", "bmi1": "bmi", "sse4_1": "sse4.1", "sse4_2": "sse4.2"}
    for level in LEVELS:
        added = {feature[1:] for feature in level.features.split(",") if feature.startswith("+")}
        assert added == {other.get(flag, flag) for flag in level.flags}


def test_flags_are_those_of_the_first_processor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("processor\t: 0\nflags\t\t: fpu avx2\n\nprocessor\t: 1\nflags\t\t: fpu\n", encoding="ascii")
    assert processor_flags(cpuinfo) == {"fpu", "avx2"}
    assert processor_flags(tmp_path / "none") == frozenset()
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert processor_flags(cpuinfo) == frozenset()


@pytest.mark.skipif(level_for({}, processor_flags()) is None, reason="no level for this processor")
@pytest.mark.parametrize("first", ["simulators", "beamline.monitor.digest as d; d._count_greys.py_func"])
def test_whoever_compiles_has_the_level_before_numba_is_there(first: str) -> None:
    """Without it numba would compile again for each processor."""
    environment = {name: value for name, value in with_our_path().items() if not name.startswith("NUMBA_")}
    code = f"""
import {first}
import os, sys
print(sys.modules["numba"].config.CPU_NAME if "numba" in sys.modules else os.environ["NUMBA_CPU_NAME"])
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    level = level_for({}, processor_flags())
    assert level is not None
    assert found.stdout.strip() == level.name
