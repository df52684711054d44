"""Documents of a scan in tiled: with these documents alone, its client reads every frame."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.beamline.ball_scan import small
from tests.beamline.bluesky.short_scan import PATHS, SHORT

for library in ("event_model", "bluesky", "ophyd_async", "bluesky_tiled_plugins"):
    pytest.importorskip(library)


@pytest.mark.filterwarnings("ignore")  # of tiled and its libraries
def test_a_scan_is_read_back(engine: Any, tmp_path: Path) -> None:
    from bluesky_tiled_plugins import TiledWriter
    from tiled.catalog import in_memory
    from tiled.client import Context, from_context
    from tiled.server.app import build_app

    from beamline.bluesky.devices import fly, tomography

    catalog = in_memory(readable_storage=[str(tmp_path / "runs")], writable_storage=str(tmp_path / "tiled"))
    with Context.from_app(build_app(catalog)) as context:
        client: Any = from_context(context)
        engine.subscribe(TiledWriter(client, batch_size=1))
        with tomography(small(*SHORT), tmp_path / "runs") as (scan, _):
            (uid,) = engine(fly(scan))
        stream = client[uid]["primary"]
        with h5py.File(next((tmp_path / "runs").iterdir()) / "scan.h5") as file:
            written = {key: file[path][()] for key, path in PATHS.items()}
        for key, values in written.items():
            np.testing.assert_array_equal(stream[key].read(), values)
