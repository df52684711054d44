"""Only regular files of a sane size are read as text."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from beamline.core.files import require_regular, text_in


def test_what_is_not_there_or_a_link_to_a_file_is_fine(tmp_path: Path) -> None:
    require_regular(tmp_path / "nowhere")
    (tmp_path / "a").write_text("1\n", encoding="utf-8")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert text_in(tmp_path / "b") == "1\n"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_a_pipe_and_a_device_are_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(OSError, match="device or a pipe, and a regular file is expected"):
            text_in(path)


def test_a_folder_and_a_file_without_end(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="It is a folder"):
        text_in(tmp_path)
    with (tmp_path / "large").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(OSError, match="at most 67108864 are read"):
        text_in(tmp_path / "large")
