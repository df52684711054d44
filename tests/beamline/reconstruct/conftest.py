"""A folder to reconstruct in, for modules that make their scan and its volumes once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def folder(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with a copy of the scan.h5 of the module's fixture `made`."""
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(made / "scan.h5", tmp_path / "scan.h5")
    return tmp_path
