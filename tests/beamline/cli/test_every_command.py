"""Laws of all commands: a wrong file ends in a sentence with its name and a documented exit code, as JSON, too, and
leaves nothing."""

import json
from pathlib import Path

import click
import pytest

from beamline.cli.main import main, own_commands
from tests.beamline.cli.small_scan import beamline, left

CONTEXT = click.Context(main)
COMMANDS = {name: command for name in own_commands() if (command := main.get_command(CONTEXT, name)) is not None}
TAKES_FILE = {
    "batch": "FILE -o out", "export": "FILE -o out.nrrd", "ingest": "FILE out.h5",
 "study": "fixed-views FILE",
    "simulate": "FILE -o out.h5", "sweep": "FILE axis=1:3:1",
}  # fmt: skip
"""Commands that need more than the name of a file."""
NO_FILE = {"config", "demo", "ioc", "pause", "resume", "stop", "abort", "decide", "runs"}
OTHERWISE = {("batch", "text"), ("batch", "cut"), ("watch", "cut")}
"""The next scan is made; it may become a scan file."""
KINDS = {
    "missing": ("none.h5", None), "text": ("text.h5", b"no HDF5"), "cut": ("cut.h5", b"\x89HDF\r\n\x1a\n"),
}  # fmt: skip


def says_json(name: str) -> bool:
    return any("--json" in option.opts for option in COMMANDS[name].params)


@pytest.mark.parametrize(
    ("name", "kind"), sorted({(name, kind) for name in COMMANDS.keys() - NO_FILE for kind in KINDS} - OTHERWISE)
)
def test_a_wrong_file_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, kind: str) -> None:
    monkeypatch.chdir(tmp_path)
    file, content = KINDS[kind]
    if content is not None:
        Path(file).write_bytes(content)
    before = left(tmp_path)
    ended = beamline(name, *TAKES_FILE.get(name, "FILE").replace("FILE", file).split(), *["--json"] * says_json(name))
    assert ended.exit_code in (2, 5), ended.output
    assert file in ended.output and "Traceback" not in ended.output and "Errno" not in ended.output
    assert left(tmp_path) == before
    said = [json.loads(line) for line in ended.stdout.splitlines() if says_json(name)]
    assert not said or said[-1]["event"] == "done" or said[-1]["exit_code"] == ended.exit_code
