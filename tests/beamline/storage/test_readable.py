"""An error of a library about file content means a damaged file; an error of our reader is a defect."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import DataError, is_defect
from beamline.storage import hdf5
from beamline.storage.readers.open import open_scan
from tests.beamline.scans import TwoCylinders, write_exchange

NONE: Any = None
MISTAKES: dict[str, Callable[[], Any]] = {
    "attribute": lambda: NONE.shape,
    "method": lambda: SimpleNamespace().close(),
    "key": lambda: {"a": 1}["b"],
    "index": lambda: [][0],
    "argument": lambda: (lambda x: x)(),  # type: ignore[call-arg]
    "operand": lambda: NONE + 1,
    "subscript": lambda: NONE["data"],
}


@pytest.mark.parametrize("mistake", MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_of_a_reader_is_a_defect(
    mistake: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "s.h5"
    write_exchange(path, TwoCylinders())
    monkeypatch.setattr("beamline.storage.readers.stacks.StacksSource.__init__", lambda *_, **__: mistake())
    with pytest.raises((AttributeError, LookupError, TypeError)) as failed:
        open_scan(path)
    assert is_defect(failed.value)


CONTENTS: dict[str, Callable[[h5py.File], Any]] = {
    "a group for a dataset": lambda file: file["group"].shape,
    "a dataset for a group": lambda file: file["list"].keys(),
    "a text for bytes": lambda file: file["group"].attrs["text"].decode(),
    "a list for a number": lambda file: int(file["list"][()]),
    "a group for a number": lambda file: float(file["group"]),
    "what is not there": lambda file: file["nothing"],
    "a scalar for a list": lambda file: len(file["number"]),
    "a word for a number": lambda file: float(file["word"][()]),
    "nothing for a number": lambda file: file["empty"][()] + 1,
}


@pytest.mark.parametrize("ask", CONTENTS.values(), ids=CONTENTS)
def test_other_content_than_promised_is_a_damaged_file(ask: Callable[[h5py.File], Any], tmp_path: Path) -> None:
    path = tmp_path / "s.h5"
    with h5py.File(path, "w") as file:
        file.create_group("group").attrs["text"] = "words"
        file["list"], file["number"], file["word"], file["empty"] = np.zeros(3), 1.0, "words", h5py.Empty("f4")
    told = r"s\.h5 is damaged or has an unexpected structure"
    with h5py.File(path) as file, pytest.raises(DataError, match=told), hdf5.readable(path):
        ask(file)
