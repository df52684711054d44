"""Only regular files of a reasonable size are read as text."""

import os
from pathlib import Path

import pytest

from beamline.core.files import bytes_below, parts_of, text_in


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_a_pipe_and_a_device_are_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(OSError, match="file is expected"):
            text_in(path)


def test_a_folder_and_a_file_without_end(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="It is a folder"):
        text_in(tmp_path)
    with (tmp_path / "large").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(OSError, match=r"too large \(1099511627776 bytes, at most 67108864\)"):
        text_in(tmp_path / "large")


def _pipe(place: Path) -> None:
    os.mkfifo(place)


def _endless(place: Path) -> None:
    place.touch()
    os.truncate(place, 2**40)


_WAYS_OUT = {
    "link": lambda place: place.symlink_to("../secret"),
    "link to a file beside": lambda place: place.symlink_to("good"),
    "link to a device": lambda place: place.symlink_to("/dev/zero"),
    "link to nothing": lambda place: place.symlink_to("gone"),
    "pipe": _pipe,
    "folder": lambda place: place.mkdir(),
    "nothing": lambda place: None,
    "too long": lambda place: place.write_bytes(bytes(9)),
    "without end": _endless,
}


@pytest.mark.skipif(os.name != "posix", reason="links and pipes take rights on Windows")
@pytest.mark.parametrize("within", ["", "c/0"])
@pytest.mark.parametrize("way", _WAYS_OUT)
def test_only_a_regular_file_below_the_folder_is_read(tmp_path: Path, way: str, within: str) -> None:
    (tmp_path / "secret").write_bytes(b"secret")
    (tmp_path / "linked").symlink_to("run")  # the folder itself may be one
    folder = tmp_path / "run" / within
    folder.mkdir(parents=True)
    (folder / "good").write_bytes(b"12345678")
    assert bytes_below(tmp_path / "linked", f"{within}/good".lstrip("/"), 8) == b"12345678"
    _WAYS_OUT[way](folder / "bad")
    with pytest.raises(OSError, match="bad"):
        bytes_below(tmp_path / "linked", f"{within}/bad".lstrip("/"), 8)


@pytest.mark.skipif(os.name != "posix", reason="links take rights on Windows")
@pytest.mark.parametrize("name", ["../secret", "part-2/secret", "a/../../secret", "/etc/passwd"])
def test_no_name_leads_out_of_the_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret").write_bytes(b"secret")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "part-2").symlink_to(tmp_path)
    with pytest.raises(OSError, match="the folder itself"):
        bytes_below(tmp_path / "run", name)
    assert parts_of(tmp_path / "run") == [tmp_path / "run"]
