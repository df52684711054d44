"""A joined file is complete, also in a copied run; if its parts have changed or are missing, there is an error."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from beamline.cli.main import main
from beamline.core.errors import DataError
from beamline.core.files import JOINED
from beamline.features.files.ingest import ingest
from beamline.scan.resume import recover_run
from beamline.storage.readers.open import open_scan
from beamline.storage.writers import layout
from tests.beamline.scan.chains import (
    START,
    VIEW,
    Chain,
    assert_whole,
    rows_of,
)
from tests.slow_cases import others_slow


@pytest.fixture(scope="module")
def killed_while_joined(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        chain = Chain(tmp_path_factory.mktemp("chain") / "runs", patch)
        chain.end("stopped", VIEW)
        chain.end("stopped", VIEW)
        chain.end("unjoined_whole", START)
        return chain.run


@pytest.fixture(scope="module")
def recovered_once(killed_while_joined: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = shutil.copytree(killed_while_joined, tmp_path_factory.mktemp("recovered") / "run")
    recover_run(run)
    assert_whole(run / JOINED)
    return run


@pytest.fixture
def recovered(recovered_once: Path, tmp_path: Path) -> Path:
    """The joined file of all three parts."""
    return shutil.copytree(recovered_once, tmp_path / "run") / JOINED


def _beamline(*words: str | Path) -> tuple[int, str]:
    said = CliRunner().invoke(main, [str(word) for word in words])
    return said.exit_code, said.output


def _fewer_frames(run: Path) -> None:
    with h5py.File(run / "part-2" / "scan.h5", "r+") as file:
        file[layout.COMMITTED][()] -= 1


def _gone(run: Path) -> None:
    (run / "part-3" / "scan.h5").unlink()


def _torn(run: Path) -> None:
    whole = (run / JOINED).read_bytes()
    (run / JOINED).write_bytes(whole[: len(whole) // 2])


def _without_its_parts(run: Path) -> None:
    with h5py.File(run / JOINED, "r+") as file:
        del file[layout.PARTS]


@pytest.mark.parametrize(
    ("change", "said"),
    others_slow(
        [
            (_fewer_frames, "part-2/scan.h5 has 7 frames, but had 8 when the parts were joined"),
            (_gone, "part-3/scan.h5 does not exist"),
            (_torn, "is cut off"),
            (_without_its_parts, "does not list its parts"),
        ]
    ),
)
def test_a_joined_file_whose_parts_changed_is_refused_and_made_again(
    recovered: Path, change: Callable[[Path], None], said: str
) -> None:
    change(recovered.parent)
    with pytest.raises(DataError, match=said.replace("/", r"[/\\]")):
        open_scan(recovered)
    recover_run(recovered.parent)
    with open_scan(recovered) as source:
        assert len(source.table) == len(rows_of(recovered.parent))


@pytest.mark.slow
def test_a_run_is_copied_as_a_whole_and_its_copy_needs_no_part(recovered: Path, tmp_path: Path) -> None:
    shutil.copytree(recovered.parent, tmp_path / "copy")
    assert_whole(tmp_path / "copy" / JOINED)
    (tmp_path / "alone").mkdir()
    shutil.copy(recovered, tmp_path / "alone")
    with pytest.raises(DataError, match="copy the whole folder of the run"):
        open_scan(tmp_path / "alone" / JOINED)
    ingest(recovered, tmp_path / "archive.h5")
    shutil.copy(tmp_path / "archive.h5", recovered.parent / "archive.h5")
    shutil.copy(tmp_path / "archive.h5", tmp_path / "alone" / JOINED)
    with open_scan(recovered) as source:
        n = len(source.table)
        for copy in (tmp_path / "archive.h5", recovered.parent / "archive.h5", tmp_path / "alone" / JOINED):
            with open_scan(copy) as archived:
                np.testing.assert_array_equal(archived.read(slice(None)), source.read(slice(None)))
    assert _beamline("recover", tmp_path / "alone" / JOINED) == (
        0,
        f"{tmp_path / 'alone' / JOINED} is intact, with {n} frames. Nothing was changed.\n",
    )


def test_while_a_later_part_grows_the_joined_file_is_refused(recovered: Path) -> None:
    """It has the frames of the parts before, and the scan goes on."""
    shutil.copytree(recovered.parent / "part-3", recovered.parent / "part-4")
    with h5py.File(recovered.parent / "part-4" / "scan.h5", "r+") as file:
        file[layout.FINISHED][()] = 0
    with pytest.raises(DataError, match=r"the frames of .*part-4.* are missing"):
        open_scan(recovered)
