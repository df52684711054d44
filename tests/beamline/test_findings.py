"""Every finding on right scans, on attacked ones and on real ones, against those that were recorded: of the monitor, of
`validate` and of the preparation of a reconstruction.

After a change that must not change what users are told, none may differ. Where one was meant to, say so in CHANGELOG.md
and record: `python -m tests.beamline.test_findings [CASE ...]`. Numbers within sentences may differ by 2 %.
"""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import pytest

from beamline.core.errors import BeamlineError
from beamline.core.text import spans
from beamline.features.files.validate import source_findings, validate, views_lit
from beamline.monitor.check import Flag
from beamline.projections.replay import by_kind, replay, verdict
from beamline.projections.selection import Selection
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import open_scan
from beamline.storage.rules.evidence import ScanEvidence
from tests.beamline.attacked_scans import SCANS
from tests.beamline.prepared_views import prepare
from tests.bench.clean_scans import clean_scan
from tests.bench.monitor_scenes import CLEAN, base_scene
from tests.bench.test_monitor_roc import STRENGTHS, anomalous_event, flags_of
from tests.conftest import SHARED_DATA

Row = list[str]
"""Who finds it, rule, severity, frames, and the sentence (of the worst frame, where each has one)."""
RECORD = Path(__file__).parent / "findings.json"
SHARED_CASES = SHARED_DATA.parent / "cases"
REAL = {
    "diamond": "diamond_24737_parallel_91x135x160.h5",
    "tooth": "aps2bm_tooth_181x2x640.h5",
    "walnut": "walnut_parallel_rebinned_240x96x256.h5",
}
MADE = ("21", "31", "32", "34", "44", "45", "54", "57", "77", "78", "83", "91", "101", "102", "103", "107", "108",
        "111", "116", "121", "123", "132", "136", "138", "140", "152")  # fmt: skip
LONG = {15, 39, 45, 52, 55}  # clean scans of 720 views, beside two others of as many


def by_the_monitor(flags: Iterable[Flag]) -> list[Row]:
    return [
        ["monitor", kind.check, str(kind.level), spans(list(kind.frames)), kind.worst.advice] for kind in by_kind(flags)
    ]


def of_source(source: ScanSource, axis: float | None = None) -> list[Row]:
    """What the monitor, `validate` and the preparation find in a scan."""
    judged = list(replay(source))
    rows = by_the_monitor(flag for each in judged for flag in each.flags)
    whole = verdict(source, judged)
    rows += [["monitor", "references", "", "", sentence] for sentence in whole.references]
    rows += [["monitor", "left out", "", "", sentence] for sentence in whole.aside]
    scan = ScanEvidence(source)
    found = dict.fromkeys([*source_findings(scan), *views_lit(scan, every=True)])
    rows += [["validate", each.rule, each.severity, "", each.message] for each in found]
    return rows + prepared(source, axis)


def prepared(source: ScanSource, axis: float | None) -> list[Row]:
    try:
        sentences = prepare(source, Selection(axis_col=axis))[1]
    except BeamlineError as error:
        return [["prepare", "refused", "error", "", str(error)]]
    return [["prepare", "", "", "", str(sentence)] for sentence in sentences]


def of_file(path: Path) -> list[Row]:
    """What is found in a file or folder, with what it is opened with by default."""
    try:
        with open_scan(path) as source:
            rows = of_source(source)
    except BeamlineError as error:
        rows = [["open", "refused", "error", "", str(error)]]
    of_scan = {(row[1], row[2], row[4]) for row in rows if row[0] == "validate"}
    others = [each for each in validate(path) if (each.rule, each.severity, each.message) not in of_scan]
    rows += [["file", each.rule, each.severity, "", each.message] for each in others]
    return [[word.replace(f"{path.parent}/", "") for word in row] for row in rows]


def of_anomaly(name: str) -> list[Row]:
    return by_the_monitor(anomalous_event(name, 0).flags)


def of_clean_scene(name: str) -> list[Row]:
    return by_the_monitor(flags_of(base_scene(name, 30), 8000, range(0, 150))[1])


def of_clean_scan(seed: int) -> list[Row]:
    source, _ = clean_scan(seed)
    return of_source(cast(ScanSource, source), source.axis_col)


def of_shared_case(name: str, files: Collection[str] = ()) -> list[Row]:
    """What is found in the files that the case makes, or in these of them."""
    with TemporaryDirectory() as folder:
        made = Path(folder).resolve() / name
        shutil.copytree(SHARED_CASES / name, made)
        made.chmod(0o755)
        shutil.copy(SHARED_CASES / "common.py", made.parent)
        before = set(made.iterdir())
        subprocess.run([sys.executable, "make.py"], cwd=made, check=True, capture_output=True)
        rows: list[Row] = []
        for path in sorted(path for path in set(made.iterdir()) - before if not files or path.name in files):
            rows += [[f"{path.name}: {who}", *row] for who, *row in of_file(path)]
        return rows


def cases() -> Mapping[str, Callable[[], list[Row]]]:
    """All cases by name; the first are the small scans."""
    small = {name: lambda make=make: of_source(cast(ScanSource, make().source()), 31.2) for name, make in SCANS.items()}
    return {
        **small,
        **{f"clean scan {seed}": lambda seed=seed: of_clean_scan(seed) for seed in range(60) if seed not in LONG},
        **{f"scene: {name}": lambda name=name: of_anomaly(name) for name in STRENGTHS},
        **{f"clean scene: {name}": lambda name=name: of_clean_scene(name) for name in CLEAN},
        **{f"real: {name}": lambda name=name: of_file(SHARED_DATA / REAL[name]) for name in REAL},
        **{f"shared: {name}": lambda name=name: of_shared_case(name) for name in MADE},
    }


CASES = cases()
QUICK = [*SCANS][::80]  # two or three small scans, in each quick run
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def alike(now: Sequence[Row], then: Sequence[Row]) -> bool:
    """Whether the same is found, in the same words; numbers may differ a little."""

    def without_numbers(rows: Sequence[Row]) -> list[Row]:
        return [[*row[:-1], _NUMBER.sub("#", row[-1])] for row in rows]

    if without_numbers(now) != without_numbers(then):
        return False
    numbers = ([float(found) for row in rows for found in _NUMBER.findall(row[-1])] for rows in (now, then))
    return all(math.isclose(a, b, rel_tol=0.02, abs_tol=0.0101) for a, b in zip(*numbers, strict=True))


@cache
def recorded() -> dict[str, list[Row]]:
    return cast(dict[str, list[Row]], json.loads(RECORD.read_text(encoding="utf-8")))


def sentences_of(rows: Iterable[Row], file: str = "") -> set[tuple[str, ...]]:
    """Each sentence with who finds it, its rule and severity; without numbers and the file's name."""
    return {
        (*who, _NUMBER.sub("#", sentence.replace(file, "FILE") if file else sentence))
        for *who, _, text in rows
        for sentence in re.split(r"(?<=\.) (?=[A-Z])", text)
    }


def new_files(rows: Iterable[Row], sentences: set[tuple[str, ...]]) -> list[str]:
    """Of a shared case the files with a sentence that is none of these, to which theirs are added."""
    files = dict[str, list[Row]]()
    for who, *row in rows:
        file, _, finder = who.partition(": ")
        files.setdefault(file, []).append([finder, *row])
    new = []
    for file, ours in files.items():
        if not (said := sentences_of(ours, file)) <= sentences:
            new.append(file)
            sentences |= said
    return new


def marked() -> list[Any]:
    """Quick ones; for the gate those that have a sentence which no case with more of them has, and of shared cases the
    files that have one; the rest."""
    said = {name: sentences_of(recorded().get(name, [])) for name in CASES if not name.startswith("shared: ")}
    sentences, in_gate = set[tuple[str, ...]](), set[str]()
    for name in sorted(said, key=lambda name: -len(said[name])):
        if not said[name] <= sentences:
            in_gate.add(name)
        sentences |= said[name]
    slow, long = pytest.mark.slow, (pytest.mark.slow, pytest.mark.long)
    of_name = dict.fromkeys(said, long) | dict.fromkeys(in_gate, (slow,)) | dict.fromkeys(QUICK, ())
    marks = [pytest.param(name, (), marks=of_name[name], id=name) for name in said]
    for name in [name for name in CASES if name not in said]:
        if files := new_files(recorded().get(name, []), sentences):
            marks.append(pytest.param(name, files, marks=slow, id=name))
        marks.append(pytest.param(name, (), marks=long, id=f"{name}, all files"))
    return marks


@pytest.mark.parametrize(("case", "files"), marked())
def test_findings_are_those_that_were_recorded(case: str, files: Collection[str]) -> None:
    """In all files of a shared case, or in these of them."""
    if case.startswith("real: ") and not (SHARED_DATA / REAL[case[6:]]).is_file():
        pytest.skip(f"{REAL[case[6:]]} is not beside this checkout (../shared/data)")
    if case.startswith("shared: ") and not (SHARED_CASES / case[8:]).is_dir():
        pytest.skip(f"case {case[8:]} is not in a folder beside the real scans")
    now = of_shared_case(case[8:], files) if files else CASES[case]()
    then = [row for row in recorded()[case] if not files or row[0].partition(": ")[0] in files]
    assert alike(now, then), "\n".join(
        [*(f"- {row}" for row in then if row not in now), *(f"+ {row}" for row in now if row not in then)]
    )


def record(wanted: Sequence[str]) -> None:
    """Write what these cases find, or all; those that are not here stay."""
    known = dict(recorded()) if RECORD.is_file() else {}
    for name in wanted or CASES:
        try:
            known[name] = CASES[name]()
        except FileNotFoundError as error:
            print(name, error, file=sys.stderr)
    ordered = {name: known[name] for name in CASES if name in known}
    lines = (
        f"{json.dumps(name)}: [\n" + ",\n".join(f"  {json.dumps(row)}" for row in rows) + "\n]" if rows
        else f"{json.dumps(name)}: []"
        for name, rows in ordered.items()
    )  # fmt: skip
    RECORD.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    record(sys.argv[1:])
