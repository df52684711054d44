"""Batches: each scan gets its volume, a failure is named, and a second call does only what is missing."""

from __future__ import annotations

import csv
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from beamline.core.events import Event, Failed, StateEntered, Warned
from beamline.core.process import ProcessEnd
from beamline.core.text import csv_text, safe_name
from beamline.features.batch import command as batch
from beamline.features.batch.command import COMMAND, BatchRow, names_of, run_batch
from beamline.storage.writer_lock import WriterLock
from beamline.storage.writers.recon_file import read_reconstruction
from drivers.base.clock import SystemClock
from tests.beamline.cli.small_scan import SCAN, beamline, left
from tests.beamline.ran import ended_run
from tests.beamline.scan.test_resume import FIRST, VIEWS, go_on
from tests.beamline.scans import write_exchange
from tests.clock import wait_until

pytestmark = pytest.mark.usefixtures("one_thread")


def _table(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "batch.csv").open(encoding="utf-8", newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scans are reconstructed without a process of their own, which takes seconds to start."""

    def run(
        command: Sequence[str], log: Path, on_line: Callable[[str], None], silence: float
    ) -> tuple[ProcessEnd, int, str]:
        log.touch()
        result = beamline(*(word for word in command[len(COMMAND) :] if word != "--beside-scan"))  # there is no pipe
        for text in result.stdout.splitlines():
            on_line(text)
        return ProcessEnd.EXITED, result.exit_code, (result.stderr.splitlines() or [""])[-1]

    monkeypatch.setattr(batch, "run_to_end", run)


@pytest.mark.usefixtures("in_this_process")
def test_all_scans_by_one_recipe_and_what_is_left_by_a_second_call(folder: Path) -> None:
    Path("recipe.yaml").write_text("method: fbp\naxis: 19.5\n")
    (folder / "a").mkdir()
    write_exchange(folder / "a" / "scan.h5", SCAN)
    Path("cut.h5").write_bytes((folder / "scan.h5").read_bytes()[:2000])
    given = ("batch", "*scan.h5", "a/*.h5", "cut.h5", "--config", "recipe.yaml", "-o", "out")

    first = beamline(*given)
    assert first.exit_code == 5
    assert "1 of 3 scans failed" in first.output
    table = _table(folder / "out")
    assert {name: row["state"] for name, row in table.items()} == {
        f"{folder.name}_scan": "done", "a_scan": "done", "cut": "failed",
    }  # fmt: skip
    assert "cut.h5" in table["cut"]["message"]
    assert left(folder / "out") == {"batch.csv", "recipe.yaml", "a_scan", f"{folder.name}_scan"}
    assert left(folder / "out" / "a_scan") == {"recon.h5", "report.html"}
    beamline("recon", "scan.h5", "--config", "recipe.yaml", "-o", "alone.h5", "--no-report")
    alone, found = (read_reconstruction(Path(name)) for name in ("alone.h5", "out/a_scan/recon.h5"))
    np.testing.assert_array_equal(found.volume.data, alone.volume.data)
    assert float(table["a_scan"]["residual"]) == alone.metrics["residual"]

    before = (folder / "out" / "a_scan" / "recon.h5").stat().st_mtime_ns
    Path("cut.h5").write_bytes((folder / "scan.h5").read_bytes())
    second = beamline(*given)
    assert second.exit_code == 0, second.output
    assert _table(folder / "out")["cut"]["state"] == "done"
    assert (folder / "out" / "a_scan" / "recon.h5").stat().st_mtime_ns == before

    Path("recipe.yaml").write_text("method: sirt\n")
    other = beamline(*given)
    assert other.exit_code == 5
    assert "another recipe" in other.output


@pytest.mark.usefixtures("in_this_process")
def test_a_result_without_a_row_is_kept_a_row_without_its_result_is_made_again_and_two_batches_do_not_share_a_folder(
    folder: Path,
) -> None:
    Path("recipe.yaml").write_text("method: fbp\n")
    given = ("batch", "scan.h5", "--config", "recipe.yaml", "-o", "out")
    assert beamline(*given).exit_code == 0
    (folder / "out" / "batch.csv").write_text("name,scan,state,seconds,method,residual,message\n")
    before = (folder / "out" / "scan" / "recon.h5").stat().st_mtime_ns
    assert beamline(*given).exit_code == 0
    assert (folder / "out" / "scan" / "recon.h5").stat().st_mtime_ns == before
    assert _table(folder / "out")["scan"]["state"] == "done"
    shutil.rmtree(folder / "out" / "scan")
    assert beamline(*given).exit_code == 0 and (folder / "out" / "scan" / "recon.h5").is_file()
    other = WriterLock(folder / "out" / "recipe.yaml")
    refused = beamline(*given)
    other.release()
    assert refused.exit_code == 5
    assert "another batch is running in this folder" in refused.output


@pytest.mark.parametrize(
    ("events", "code", "warnings", "said"),
    [
        ([], 0, 0, ""),
        ([Warned("A."), StateEntered("rings", "Take --rings auto."), Warned("B.")], 0, 2, "A. B."),
        ([Warned("Give --cone.")], 0, 1, "Give --cone. If the options in this message apply to all scans"),
        (
            [Warned("A."), Failed("Over --max-residual.")],
            6,
            1,
            "Over --max-residual. A. If the options in this message apply ",
        ),
        ([Warned("A (-log)."), Failed("`beamline scan --resume R`.")], 5, 1, "`beamline scan --resume R`. A (-log)."),
    ],
)
def test_a_row_has_what_its_reconstruction_warned_of_and_whose_the_options_are(
    folder: Path, monkeypatch: pytest.MonkeyPatch, events: Sequence[Event], code: int, warnings: int, said: str
) -> None:
    def run(
        command: Sequence[str], log: Path, on_line: Callable[[str], None], silence: float
    ) -> tuple[object, int, str]:
        log.touch()
        Path(command[command.index("--output") + 1]).touch()
        for event in events:
            on_line(replace(event, time=0.0).to_json())
        return ProcessEnd.EXITED, code, ""

    monkeypatch.setattr(batch, "run_to_end", run)
    passed_on: list[Event] = []
    (row,) = run_batch([Path("scan.h5")], None, Path("out"), passed_on.append, SystemClock())
    assert (row.warnings, row.message[: len(said)]) == (warnings, said)
    assert ("`beamline recon" in row.message) == ("If the options in this message" in said)
    assert _table(Path("out"))["scan"]["warnings"] == str(warnings)
    for event in passed_on:
        assert "--" not in event.data.get("message", "") or "`beamline " in event.data["message"]


def test_a_stop_leaves_the_scans_that_are_done_and_nothing_half(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_exchange(folder / "second.h5", SCAN)
    done: list[Path] = []

    def run(command: Sequence[str], log: Path, *_: object, **__: object) -> tuple[ProcessEnd, int, str]:
        output = Path(command[command.index("--output") + 1])
        log.touch()
        if done:
            output.with_suffix(".h5.partial").touch()
            raise KeyboardInterrupt
        done.append(output)
        output.touch()
        return ProcessEnd.EXITED, 0, ""

    monkeypatch.setattr(batch, "run_to_end", run)
    result = beamline("batch", "scan.h5", "second.h5", "-o", "out")
    assert result.exit_code == 4
    assert {name: row["state"] for name, row in _table(folder / "out").items()} == {"scan": "done", "second": "waiting"}
    assert left(folder / "out") == {"batch.csv", "recipe.yaml", "scan"}


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("import os, sys; print('out of memory', file=sys.stderr, flush=True); os.abort()", "out of memory"),
        ("import time; time.sleep(600)", "the process of this scan was ended, because it printed nothing for 1.5 s"),
        ("", "the process of this scan ended with code 0"),
    ],
)
def test_a_scan_whose_process_crashes_or_hangs_or_leaves_no_volume_fails_with_the_reason(
    folder: Path, monkeypatch: pytest.MonkeyPatch, program: str, reason: str
) -> None:
    monkeypatch.setattr(batch, "COMMAND", (sys.executable, "-c", program))
    monkeypatch.setattr(batch, "_SILENCE", 1.5)
    (row,) = run_batch([Path("scan.h5")], None, Path("out"), lambda _: None, SystemClock())
    assert row.state == "failed" and reason in row.message
    assert left(folder / "out") == {"batch.csv", "recipe.yaml"}


@pytest.mark.slow
def test_in_a_process_of_its_own_a_volume_beyond_the_limit_of_the_residual_is_kept_and_named(folder: Path) -> None:
    Path("recipe.yaml").write_text("method: fbp\nmax-residual: 1e-6\n")
    (row,) = run_batch([Path("scan.h5")], Path("recipe.yaml"), Path("out"), lambda _: None, SystemClock())
    assert row.state == "poor"
    assert "--max-residual" in row.message
    assert Path("out/scan/recon.h5").is_file()


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (("/x/a.h5", "/x/b.h5"), ["a", "b"]),
        (("/x/run1/scan.h5", "/x/run2/scan.h5", "/x/c.h5"), ["run1_scan", "run2_scan", "c"]),
        (("/1/r/s.h5", "/2/r/s.h5"), ["1_r_s", "2_r_s"]),
        (("/x/s.h5", "/x/s.tif"), ["x_s", "x_s_2"]),
        (("/a/Tooth.h5", "/b/tooth.h5"), ["a_Tooth", "b_tooth"]),  # one folder on some disks
    ],
)  # fmt: skip
def test_names_tell_files_apart(paths: tuple[str, ...], names: list[str]) -> None:
    assert names_of([Path(path) for path in paths]) == names


def test_rows_of_an_earlier_call_keep_their_names() -> None:
    known = [BatchRow("scan", "/x/run1/scan.h5", "done")]
    rows = batch._rows([Path("/x/run1/scan.h5"), Path("/x/run2/scan.h5")], known)
    assert [row.name for row in rows] == ["scan", "run2_scan"]
    assert batch.batch.name == "batch"


@pytest.mark.usefixtures("in_this_process")
def test_names_that_mean_something_else_are_only_names(folder: Path) -> None:
    Path("recipe.yaml").write_text("method: fbp\naxis: 19.5\n")
    hostile = ("..h5", "batch.csv.h5", "recipe.yaml.h5", "=1+1.h5", "[", "\x1b[2J.h5", f"{'x' * 246}.h5")
    Path("in/[").mkdir(parents=True)
    for name in hostile:
        Path("in", name if name != "[" else "[/b].h5").write_bytes((folder / "scan.h5").read_bytes())
    Path("in/circle.h5").symlink_to("circle.h5")
    os.mkfifo("in/pipe.h5")
    for _ in range(2):
        result = beamline("batch", "in/*.h5", "in/[[]/*.h5", "--config", "recipe.yaml", "-o", "out")
        assert result.exit_code == 5 and "2 of 9 scans failed" in result.output, result.output
        assert "\x1b" not in result.output
    table = _table(folder / "out")
    assert {"unnamed", "batch.csv_2", "recipe.yaml_2", "1+1", "b]", "_[2J", "x" * 120} < table.keys()
    assert all(name == safe_name(name) for name in table)
    made = {name for name, row in table.items() if row["state"] == "done"}
    assert left(folder / "out") == {"batch.csv", "recipe.yaml", *made}
    assert "\x1b" not in Path("out/batch.csv").read_text()


@pytest.mark.usefixtures("in_this_process")
def test_a_resumed_run_is_one_row_of_all_its_parts(folder: Path, tmp_path: Path) -> None:
    run = ended_run(tmp_path / "runs", "stopped", at=FIRST + 4)
    Path("recipe.yaml").write_text("method: fbp\naxis: 5.5\n")
    before = batch._rows([run / "scan.h5"], [])
    go_on(run)
    given = [run / name for name in ("scan.h5", "part-2/scan.h5", "joined.h5", ".")]
    result = beamline("batch", run.parent / "*/scan.h5", *given, "--config", "recipe.yaml", "-o", "out")
    assert result.exit_code == 0, result.output
    assert f"{run / 'scan.h5'} is only a part of a resumed run. {run / 'joined.h5'}" in result.stderr
    assert {name: row["scan"] for name, row in _table(folder / "out").items()} == {"scan": str(run / "joined.h5")}
    assert read_reconstruction(Path("out/scan/recon.h5")).parameters["n_views"] == VIEWS
    assert [row.scan for row in batch._rows([run], before)] == [str(run / "joined.h5")]
    part = beamline("recon", run / "scan.h5", "-m", "fbp", "-o", "part.h5")
    assert part.exit_code == 5 and f"use {run / 'joined.h5'}," in part.output and not Path("part.h5").exists()
    (run / "joined.h5").unlink()
    result = beamline("batch", run / "scan.h5", "--config", "recipe.yaml", "-o", "other")
    assert result.exit_code == 5 and f"beamline recover {run}" in _table(folder / "other")["scan"]["message"]


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("name", ["./../victim", "..", "/victim", "a/b", "batch.csv", "Scan", "-o", "a\\b", ".hidden"])
def test_a_table_of_names_that_are_not_of_this_program_is_refused_and_nothing_is_touched(
    folder: Path, name: str
) -> None:
    Path("recipe.yaml").write_text("method: fbp\n")
    given = ("batch", "scan.h5", "--config", "recipe.yaml", "-o", "out")
    Path("out").mkdir()
    Path("victim.partial").mkdir()
    Path("out/recipe.yaml").write_text("method: fbp\n")
    rows = csv_text([["name", "scan", "state"], ["scan", "x.h5", "done"], [name, folder / "scan.h5", "waiting"]])
    Path("out/batch.csv").write_text(rows.replace("'-o", "-o"))
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    result = beamline(*given)
    assert result.exit_code == 5 and f"{name!r} is not a valid folder name for a scan" in result.stderr
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


def test_a_killed_batch_leaves_no_reconstruction_behind_and_can_be_called_again_at_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would go on in the folder of the next call."""
    Path("recipe.yaml").write_text("method: sirt\niterations: 10000000\naxis: 19.5\n")
    process = psutil.Popen([*COMMAND, "batch", "scan.h5", "--config", "recipe.yaml", "-o", "out"])
    wait_until(lambda: any(Path("out").glob(".*.partial/stderr.txt")) and process.children(recursive=True))
    children = process.children(recursive=True)
    process.kill()
    process.wait()

    def run(command: Sequence[str], log: Path, *_: object, **__: object) -> tuple[ProcessEnd, int, str]:
        log.touch()
        Path(command[command.index("--output") + 1]).touch()
        return ProcessEnd.EXITED, 0, ""

    monkeypatch.setattr(batch, "run_to_end", run)
    assert beamline("batch", "scan.h5", "--config", "recipe.yaml", "-o", "out").exit_code == 0
    assert left(folder / "out") == {"batch.csv", "recipe.yaml", "scan"}
    assert children and not psutil.wait_procs(children, 30)[1]
