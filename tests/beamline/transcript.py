"""Transcripts: command lines and the errors with which they end, as text files.

A transcript is a text file of blocks, with an empty line between two:

    recipe.yaml < method: [fbp, r2]\\n
    $ recon scan.h5 --config recipe.yaml (--dry-run)
    2 Error: ...

Lines with `<` define additional files for the block. The command is called with and without the part in brackets. The
last line is the exit code and the message, with white space joined. In all cases stdout must stay empty and no file may
change.

`python -m tests.beamline.transcript [FILE ...]` rewrites the last lines (without a name: of all transcripts). Read the
differences.
"""

from __future__ import annotations

import contextlib
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import tifffile

from tests.beamline.cli.small_scan import SCAN, beamline
from tests.beamline.scans import BEAM, DARK, write_exchange

VIEWS = SCAN.angles.size
SHAPE = (VIEWS, *SCAN.shape)
_IN_DARK = np.arange(VIEWS)[:, None, None] % 5 < 3
SCANS: dict[str, dict[str, np.ndarray | None]] = {
    "scan": {},
    "no_flats": {"data_white": None},
    "no_darks": {"data_dark": None},
    "no_references": {"data_white": None, "data_dark": None},
    "other_flats": {"data_white": np.full((2, 2, 30), 9000, np.uint16)},
    "one_image": {"data": np.zeros((2, 40), np.uint16)},
    "no_angles": {"theta": None},
    "few_angles": {"theta": np.zeros(4)},
    "nan_angles": {"theta": np.full(VIEWS, np.nan)},
    "all_nan": {"data": np.full(SHAPE, np.nan, np.float32)},
    "one_view": {"data": np.full((1, *SCAN.shape), 9000, np.uint16), "theta": np.zeros(1)},
    "no_beam": {"data_white": np.full((2, *SCAN.shape), DARK, np.uint16)},
    "black": {"data": np.where(_IN_DARK, DARK, SCAN.counts()).astype(np.uint16)},
    "empty_field": {"data": np.full(SHAPE, DARK + BEAM, np.uint16)},
}
"""A valid scan, and scans with one fault each."""
VOLUMES = {
    "scan": np.arange(8.0).reshape(2, 2, 2), "ramp": np.arange(120.0).reshape(4, 5, 6), "even": np.ones((4, 5, 6)),
    "holes": np.full((4, 5, 6), np.nan), "flat": np.ones((5, 6)), "scalar": np.float32(3),
}  # fmt: skip


@cache
def world() -> Path:
    """A folder with scans and other files that a user may name."""
    folder = Path(_WORLD.name)
    for name, changes in SCANS.items():
        write_exchange(folder / f"{name}.h5", SCAN, changes)
    np.savez(folder / "volume.npz", data=np.zeros((4, 5, 6), np.float32))
    for name, volume in VOLUMES.items():
        np.save(folder / f"{name}.npy", np.asarray(volume))
    tifffile.imwrite(folder / "in.tif", SCAN.line_integrals().astype(np.float32), photometric="minisblack")
    np.savetxt(folder / "angles.txt", np.degrees(SCAN.angles))
    (folder / "text.h5").write_text("no scan")
    (folder / "empty.h5").write_bytes(b"")
    (folder / "half.h5").write_bytes((folder / "scan.h5").read_bytes()[:3000])
    (folder / "folder").mkdir()
    np.savetxt(folder / "turn.txt", np.linspace(0, 360, VIEWS, endpoint=False))
    return folder


_WORLD = TemporaryDirectory(prefix="world-")
_LONG = re.compile(r"((?:[\w.-]+, ){4})(?:[\w.-]+, )+[\w.-]+")  # long lists, because features and add-ons extend them


@dataclass(frozen=True)
class Block:
    """A command, its part in brackets, its files, and its exit code with the message."""

    command: str
    files: tuple[str, ...]
    said: str

    def lines(self) -> list[str]:
        return [*self.files, f"$ {self.command}", self.said]

    def refused(self) -> Block:
        """The block with the present exit code and message."""
        plain, _, more = self.command.partition(" (")
        words = shlex.split(plain)
        said = {_said([*words, *rest]) for rest in ([], more.rstrip(")").split())}
        assert len(said) == 1, f"{self.command}: {said}"
        return replace(self, said=said.pop())

    @contextlib.contextmanager
    def in_its_world(self) -> Iterator[Path]:
        """The current directory; afterwards it is restored."""
        with contextlib.chdir(world()):
            for file in self.files:
                name, _, content = file.partition(" < ")
                Path(name).write_text(content.encode().decode("unicode_escape"), encoding="utf-8")
            try:
                yield Path()
            finally:
                for file in self.files:
                    Path(file.partition(" < ")[0]).unlink()


def _said(words: list[str]) -> str:
    """Exit code and message of a command, which must not have changed anything."""
    before = _stamps()
    done = beamline(*words)
    assert (done.stdout, _stamps()) == ("", before), f"{words}: {done.output}"
    sentences = re.split(r"^(?=beamline: |Error: )", done.stderr, flags=re.MULTILINE)
    assert len(sentences) == 2 and "Traceback" not in done.stderr, done.output
    sentence = _LONG.sub(r"\1...", " ".join(sentences[1].split()))
    return f"{done.exit_code} {sentence}"


def _stamps() -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in Path().rglob("*")}


def read(path: Path) -> list[Block]:
    blocks = []
    for text in path.read_text(encoding="utf-8").strip().split("\n\n"):
        before, _, after = f"\n{text}".partition("\n$ ")
        command, _, said = after.partition("\n")
        blocks.append(Block(command, tuple(before.split("\n")[1:]), said))
    return blocks


def refusals(beside: str) -> Callable[..., None]:
    """The test of the refusals.txt next to a file."""
    blocks = read(Path(beside).with_name("refusals.txt"))

    @pytest.mark.usefixtures("one_thread")
    @pytest.mark.parametrize("block", blocks, ids=[block.command for block in blocks])
    def test(block: Block) -> None:
        with block.in_its_world():
            found = block.refused().said
        assert found == block.said, f"{found}, and not {block.said}"

    return test


def main(names: list[str]) -> None:
    for path in map(Path, names) if names else Path("tests").rglob("refusals.txt"):
        anew = []
        for block in read(path):
            with block.in_its_world():
                anew.append("\n".join(block.refused().lines()))
        path.write_text("\n\n".join(anew) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
