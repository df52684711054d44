"""Our JSON can be read by every JSON reader: it contains no NaN and no Infinity, which only Python reads."""

from __future__ import annotations

import ast
import json
import math
from pathlib import Path

import numpy as np
import pytest

import recon
from beamline.core.events import json_of
from beamline.storage.run_record import RunRecord, read_record, write_record
from recon.base.method import Reconstruction
from recon.base.volume import Grid, Volume

ROOT = Path(recon.__file__).parents[1]
EXACT = {
    "recon/base/method.py": "settings, for `Reconstruction.load`",
    "beamline/storage/writers/partial_volume.py": "what a volume that is not whole yet keeps, for who goes on with it",
    "packages/splatline-areadetector/splatline_areadetector/receiver.py": "attributes of frames, for a process of ours",
}
"""Where NaN and infinities are written, for this program alone."""


def _dumped(path: Path) -> list[ast.Call]:
    """Calls of json.dump and json.dumps in a file, under any name that they are imported by."""
    text = path.read_text("utf-8")
    calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)] if "json" in text else []
    return [
        call
        for call in calls
        if ast.unparse(call.func).rpartition(".")[2] in ("dump", "dumps", "JSONEncoder") and "json" in ast.unparse(call)
    ]


def test_every_writer_of_json_refuses_what_is_none() -> None:
    """Most go through `json_of`, which writes null; what has no numbers but these says allow_nan=False."""
    folders = ("beamline", "recon", "drivers", "simulators", "packages")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*.py") if "tests" not in path.parts]
    found = {
        (path.relative_to(ROOT).as_posix(), call.lineno, ast.unparse(call)) for path in files for call in _dumped(path)
    }
    assert {"beamline/core/events.py", *EXACT} <= {path for path, _, _ in found}
    wanted = dict.fromkeys(EXACT, "allow_nan=True")
    assert [each for each in found if wanted.get(each[0], "allow_nan=False") not in each[2]] == []
    imported = [path for path in files if "from json import" in path.read_text("utf-8")]
    assert imported == []


def _strict(text: str) -> object:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, np.float32("inf"), np.array([np.nan, -np.inf])])
def test_json_has_null_for_what_is_no_number(tmp_path: Path, value: object) -> None:
    written = _strict(json_of({"a": value, "b": [(value, 1.5)], "c": {"d": value}, "e": RunRecord("done")}))
    null = [None, None] if isinstance(value, np.ndarray) else None
    assert isinstance(written, dict)
    assert (written["a"], written["b"], written["c"]) == (null, [[null, 1.5]], {"d": null})
    assert written["e"]["state"] == "done"


def test_files_with_json_are_strict(tmp_path: Path) -> None:
    write_record(tmp_path, RunRecord("done", True, frames=3, flags={"beam": {"warn": 2}}))
    record = read_record(tmp_path)
    assert record is not None and (record.frames, record.flags) == (3, {"beam": {"warn": 2}})


def test_settings_come_back_as_they_were(tmp_path: Path) -> None:
    given = {"a": math.inf, "b": 1.5, "c": "NaN", "d": [-math.inf, math.nan]}
    Reconstruction(Volume(np.zeros((2, 2, 2), np.float32), Grid((2, 2, 2), 1.0)), given, ()).save(tmp_path / "v.npz")
    assert repr(dict(Reconstruction.load(tmp_path / "v.npz").settings)) == repr(given)
