"""The registry of checks: bits that never move, limits that are values, and a check that needs only its line."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import FrozenInstanceError, fields, is_dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import beamline
from beamline.monitor.check import Check, Flag, Level, ScanContext
from beamline.monitor.checks import ALARM_SHIFT, CHECKS, _distinct, bitmask
from beamline.monitor.digest import digest

REPOSITORY = Path(beamline.__file__).parents[1]
BITS = {"beam": 0, "saturation": 1, "stuck": 2, "bands": 3, "timing": 4, "mass": 5, "dark": 6}
"""As files hold them since the first version: a number here is never changed."""

check_of_each_name = pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)


def test_the_bits_are_those_of_the_files_that_exist() -> None:
    assert ({check.name: check.bit for check in CHECKS}, ALARM_SHIFT) == (BITS, 16)


@given(st.lists(st.tuples(st.sampled_from(sorted(BITS)), st.sampled_from(Level)), unique_by=lambda pair: pair[0]))
def test_every_set_of_flags_has_its_own_bits(found: list[tuple[str, Level]]) -> None:
    bits = bitmask([Flag(check, level, 0, 1.0, 0.0, "") for check, level in found])
    assert bits == sum(1 << BITS[name] for name, _ in found) + sum(
        1 << 16 + BITS[name] for name, level in found if level is Level.ALARM
    )
    assert 0 <= bits < 2**32


@pytest.mark.parametrize("change", [{"bit": 3}, {"name": "bands"}, {"bit": 16}, {"bit": -1}])
def test_a_check_with_a_bit_or_a_name_that_is_taken_is_refused(change: dict[str, Any]) -> None:
    bands = next(check for check in CHECKS if check.name == "bands")
    other = type("Other", (type(bands),), {"name": "other", "bit": 7} | change)()
    with pytest.raises(ValueError, match=r"a bit \(0 \.\.\. 15\) of its own, got .*bands 3"):
        _distinct(*CHECKS, other)


@check_of_each_name
def test_a_check_is_a_frozen_value_and_so_is_its_state(check: Check) -> None:
    assert check == type(check)()
    assert is_dataclass(check.start()) and type(check.start()).__dataclass_params__.frozen  # type: ignore[attr-defined]
    for limit in fields(check):
        assert replace(check, **{limit.name: 7}) != check
        with pytest.raises(FrozenInstanceError):
            setattr(check, limit.name, 7)
    assert check.unit and check.meaning and check.meaning[-1] != "."
    assert list(signature(check.look).parameters) == ["state", "frame", "digest", "context"]


@check_of_each_name
def test_a_look_changes_neither_the_check_nor_the_state_it_was_given(fake: Any, check: Check) -> None:
    state, context = check.start(), ScanContext(65535, 64 * 96, 0.1)
    for frame in fake.flats(3) + fake.views(12) + fake.darks(2, light=1.0) + fake.views(12, light=0.5):
        found = digest(frame.counts, 65535, 4)
        first, again = check.look(state, frame, found, context), check.look(state, frame, found, context)
        assert first.flag == again.flag
        state = first.state


DUMMY = '''
"""A check that flags every second frame."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import Field

from beamline.monitor.check import Flag, Level, Look


@dataclass(frozen=True)
class Dummy:
    name: ClassVar[str] = "dummy"
    bit: ClassVar[int] = 11
    unit: ClassVar[str] = "frames"
    meaning: ClassVar[str] = "the frame is one of a pair"
    every: Annotated[int, Field(ge=2, description="frames between two flags")] = 3

    def start(self):
        return 0

    def look(self, state, frame, digest, context):
        if (state + 1) % self.every:
            return Look(state + 1)
        return Look(state + 1, Flag(self.name, Level.ALARM, frame.index, state + 1, self.every, "Do nothing."))
'''

SCAN = """
import json, sys
import beamline.monitor.checks as checks
assert checks.__file__.startswith(sys.argv[1]), checks.__file__
from beamline.config.load import config_folder, load
from beamline.core.errors import ConfigError
from beamline.scan.run import run_scan
from beamline.storage.describe import describe
import h5py
from pathlib import Path

words = ["simulation.clock=virtual", "scan.angles.views=6", "devices.camera.roi=[1140, 2008, 24, 80]"]
words += ["scan.darks.count=2", "scan.flats.count=2", "scan.flats.at=start", "scan.period_s=2", "scan.mode=step"]
path = config_folder() / "demo.yaml"
try:
    load(path, ["monitor.dummy.every=1"], {})
except ConfigError as error:
    refused = str(error)
config, flags = load(path, [*words, "monitor.dummy.every=2"], {}), []
sinks = [lambda event: flags.append(event.data.get("check"))]
result = run_scan(config, Path(sys.argv[1]) / "runs", sinks)
with h5py.File(result.path) as file:
    legend = file["entry/frame_log/flag_legend"]
    row = list(legend["name"].asstr()[()]).index("dummy")
    said = [int(legend[name][row]) for name in ("bit", "alarm_bit")]
    said += [legend[name].asstr()[row] for name in ("unit", "meaning")]
    bits = [int(b) & (1 << 11 | 1 << 27) for b in file["entry/frame_log/flags"][()]]
info = describe(result.path)["attributes"]["flags"]
print(json.dumps([refused, result.flags["dummy"], "dummy" in flags, said, bits, info]))
"""


def test_a_new_check_needs_its_file_and_its_line_and_nothing_else(tmp_path: Path) -> None:
    """In a copy of the package: it is configured, run, written with its bit and listed in the legend."""
    shutil.copytree(REPOSITORY / "beamline", tmp_path / "beamline")
    shutil.copytree(REPOSITORY / "configs", tmp_path / "configs")
    monitor = tmp_path / "beamline" / "monitor"
    (monitor / "dummy.py").write_text(DUMMY)
    registry = (monitor / "checks.py").read_text()
    last = '    "dark": "Dark",\n'
    assert last in registry
    (monitor / "checks.py").write_text(registry.replace(last, last + '    "dummy": "Dummy",\n'))
    (tmp_path / "scan.py").write_text(SCAN)
    done = subprocess.run(
        [sys.executable, "scan.py", str(tmp_path)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (tmp_path, REPOSITORY)))},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    refused, n, announced, said, bits, info = json.loads(done.stdout.splitlines()[-1])
    assert "monitor.dummy.every is 1; expected a whole number >= 2" in refused
    assert (n, announced) == (5, True)
    assert said == [11, 27, "frames", "the frame is one of a pair"]
    assert bits == [0, 1 << 11 | 1 << 27] * 5
    assert "dummy 5" in info
