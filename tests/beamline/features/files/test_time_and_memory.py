"""`info` ends in time, and unpacks no more of a damaged or hostile archive than it shows."""

from __future__ import annotations

import io
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
import tifffile

from beamline.features.files import validate as described
from beamline.storage.readers import no_data, transforms
from tests.beamline.scans import TwoCylinders, write_exchange


def test_info_unpacks_no_large_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (transforms, no_data):
        monkeypatch.setattr(module, "UNPACKED", 2**22)
    image = io.BytesIO()
    tifffile.imwrite(image, np.zeros((4096, 4096), np.uint16))
    with zipfile.ZipFile(tmp_path / "s.zip", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        for n in range(2):
            packed.writestr(f"p_{n:03d}.tif", image.getvalue())
    tracemalloc.start()
    facts = described.describe(tmp_path / "s.zip")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert facts["shape"] == (4096, 4096) and facts["dtype"] == "uint16"
    assert peak < 1.2 * image.tell()  # zipfile unpacks 16 MB and copies them, to find the end of a member


def test_info_does_not_wait_for_frames_that_each_cost_the_whole_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_exchange(tmp_path / "a.h5", TwoCylinders())
    monkeypatch.setattr(transforms, "UNPACKED", 100)
    (said,) = [message for message in described.describe(path)["findings"] if "too long" in message]
    assert "beamline validate" in said
    monkeypatch.undo()
    monkeypatch.setattr(described, "LOOK", -1.0)
    assert any("too long" in message for message in described.describe(path)["findings"])
