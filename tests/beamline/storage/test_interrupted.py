"""A run that ended early: all commands describe it in the same way, and accept its folder as scan or volume."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from beamline.cli.main import main
from beamline.core.errors import DataError
from beamline.scan.resume import recover_run
from beamline.storage.interrupted import next_step, scan_file, volume_file
from beamline.storage.writer_lock import WriterLock
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import Ran, ended_run
from tests.beamline.scan.test_resume import go_on

AT = 10  # frames: in the views


def beamline(*words: Any) -> Result:
    return CliRunner().invoke(main, [str(word) for word in words])


def _both(run: Path) -> str:
    return (
        f"`beamline scan --resume {run}` takes the missing projections, `beamline recover {run}` makes an ordinary "
        "file of the complete frames."
    )


@pytest.fixture(scope="module")
def died(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose program was killed."""
    return ended_run(tmp_path_factory.mktemp("died"), "killed", at=AT)


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that is whole."""
    run = Ran(tmp_path_factory.mktemp("ended"), FakeInstrument()).folder
    assert run is not None
    return run


@pytest.mark.parametrize(
    "words",
    [
        ("recon",), ("info",), ("validate",), ("monitor",), ("view",), ("runs",), ("export", "-o", "a.tif"),
    ],
    ids=lambda words: words[0],
)  # fmt: skip
def test_all_commands_say_the_same_of_a_scan_that_died(
    died: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    log = died / "events.jsonl"
    log.write_text("".join(line for line in log.read_text().splitlines(True) if '"run_started"' in line))
    monkeypatch.chdir(tmp_path)
    command, *options = words
    result = beamline(command, died.parent if command == "runs" else died, *options)
    assert f"The process of the scan was killed: {_both(died)}" in result.output


def test_a_scan_that_died_can_be_resumed_or_recovered_and_its_file_alone_be_recovered(
    died: Path, tmp_path: Path
) -> None:
    scan, alone = died / "scan.h5", tmp_path / "alone.h5"
    assert next_step(scan) == f"The process of the scan was killed: {_both(died)}"
    shutil.copy2(scan, alone)
    said = (
        f"The process of the scan was killed: `beamline recover {alone}` makes an ordinary file of the complete frames."
    )
    assert next_step(alone) == said
    for file in (scan, alone):
        os.utime(file)
    assert next_step(scan) == f"The process of the scan was killed: {_both(died)}"
    assert next_step(alone).startswith(
        "The process of the scan was killed, unless a program is still writing to it: "
    )  # perhaps no locks
    for lock in (WriterLock(scan), WriterLock(died / "config.resolved.yaml", exclusive=True)):
        assert next_step(scan).startswith(f"The scan is still running: `beamline watch {died}`")
        assert "recover" not in next_step(scan)
        lock.release()


@pytest.mark.slow
@pytest.mark.parametrize("end", ["stopped", "aborted"])
def test_a_scan_that_ended_early_can_be_resumed_until_nothing_is_missing(tmp_path: Path, end: str) -> None:
    run = ended_run(tmp_path, end, at=AT)
    said = f"The run ended early: `beamline scan --resume {run}` takes the missing projections."
    assert next_step(run / "scan.h5") == said
    assert said in beamline("validate", run).output
    assert said in beamline("recon", run, "-m", "fbp", "-o", tmp_path / "part.h5", "--no-report").output
    go_on(run)
    assert next_step(run / "scan.h5") == next_step(run / "joined.h5") == ""
    assert scan_file(run) == run / "joined.h5"
    assert "--resume" not in beamline("validate", run / "scan.h5").output


def test_nobody_is_told_to_continue_a_ride(tmp_path: Path) -> None:
    for end in ("killed", "stopped"):
        run = ended_run(tmp_path / end, end, at=AT)
        with (run / "config.resolved.yaml").open("a") as config:
            config.write("\nride: {image: pva://X:Pva1:Image}\n")
    died, stopped = (next_step(next((tmp_path / end).rglob("scan.h5"))) for end in ("killed", "stopped"))
    assert died.startswith("The process of the scan was killed: `beamline recover ") and "--resume" not in died
    assert (
        stopped
        == "The run ended early. The run recorded the scan of another program, so `beamline` cannot continue it."
    )


def test_parts_that_are_not_joined_are_not_taken_for_the_scan(tmp_path: Path) -> None:
    run = ended_run(tmp_path, "killed", at=AT)
    go_on(run)
    (run / "joined.h5").unlink()
    with pytest.raises(DataError, match="has 2 parts"):
        scan_file(run)
    recover_run(run)
    assert scan_file(run) == run / "joined.h5"


def test_the_folder_of_a_run_is_its_volume(ended: Path) -> None:
    with pytest.raises(DataError, match=r"has no volume .*`beamline recon .* makes it"):
        volume_file(ended)
    (ended / "recon.h5").touch()
    assert volume_file(ended) == ended / "recon.h5"


def test_other_folders_and_files_are_what_they_are(ended: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=f"as {ended}"):
        scan_file(ended.parent)
    with pytest.raises(DataError, match="contains several runs"):
        volume_file(ended.parent)
    (tmp_path / "slices").mkdir()
    for path in (tmp_path / "slices", tmp_path / "missing.h5"):
        assert scan_file(path) == volume_file(path) == path
    (ended / "scan.h5").rename(tmp_path / "scan.h5")
    with pytest.raises(DataError, match="its first frame"):
        scan_file(ended)
    (tmp_path / "scan.h5").rename(ended / "scan.h5")
