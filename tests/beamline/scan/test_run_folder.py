"""The folder of a run and its logs are new; no existing file is reused or overwritten."""

from pathlib import Path

import pytest

from beamline.core.files import create_run_folder, new_log


@pytest.mark.parametrize("taken", [0, 1, 3])
def test_a_folder_is_never_used_twice(tmp_path: Path, taken: int) -> None:
    made = [create_run_folder(tmp_path / "runs", "cell", 1_795_152_753.0) for _ in range(taken + 1)]
    assert len(set(made)) == taken + 1
    assert made[0].name == "2026-11-20T05-32-33_cell"
    assert all(folder.is_dir() for folder in made)


def test_a_file_in_the_way_of_the_folder_stays(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("a file")
    with pytest.raises(FileExistsError):
        create_run_folder(tmp_path / "runs", "cell", 0.0)
    assert (tmp_path / "runs").read_text() == "a file"


def test_a_log_that_is_there_is_not_gone_on_with(tmp_path: Path) -> None:
    with new_log(tmp_path / "user.log") as log:
        log.write("first\n")
    with pytest.raises(FileExistsError), new_log(tmp_path / "user.log"):
        pass
    assert (tmp_path / "user.log").read_text(encoding="utf-8") == "first\n"
