"""Volumes in napari: every layer has the right position and unit. A stand-in for napari records the calls."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from beamline.core.errors import ConfigError, DataError
from beamline.features.page.in_napari import show
from beamline.storage.volumes.base import bare_record
from beamline.storage.volumes.files import write_volume

RAMP = np.arange(480, dtype=np.float32).reshape(6, 8, 10)


@pytest.fixture
def layers(monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
    """Layers by their names, with the values that are there while the window is open."""
    found: dict[str, tuple[np.ndarray, dict[str, Any]]] = {}

    def add(data: Any, name: str, **said: Any) -> None:
        found[name] = np.asarray(data[:, 1]), said

    fake: Any = ModuleType("napari")
    fake.Viewer = lambda title: SimpleNamespace(add_image=add, add_labels=add, add_points=add)
    fake.run = lambda: found.setdefault("run", (np.empty(0), {}))
    monkeypatch.setitem(sys.modules, "napari", fake)
    return found


@pytest.mark.parametrize("name", ["v.h5", "v.zarr", "v.npy", "v"])
def test_a_volume_has_its_place_and_unit(tmp_path: Path, layers: dict[str, Any], name: str) -> None:
    write_volume(tmp_path / name, bare_record(tmp_path, RAMP, (0.2, 0.1, 0.1)))
    tifffile.imwrite(tmp_path / "l.tif", (RAMP > 100).astype(np.uint8))
    show([tmp_path / name], tmp_path / "l.tif")
    values, said = layers[name]
    np.testing.assert_array_equal(values, RAMP[:, 1])
    if name != "v.npy":  # which says nothing of its voxels
        np.testing.assert_allclose(said["scale"], (0.2, 0.1, 0.1))
        np.testing.assert_allclose(said["translate"], (-0.5, -0.35, -0.45))
        assert said["units"] == ("mm",) * 3
    found, labelled = layers[str(tmp_path / "l.tif")]
    np.testing.assert_array_equal(found, RAMP[:, 1] > 100)
    assert labelled == said
    assert list(layers)[-1] == "run"


def test_labels_of_a_part_of_the_volume_stand_where_they_are(tmp_path: Path, layers: dict[str, Any]) -> None:
    """`structure` crops by default: its labels were refused, as another shape than the volume's."""
    write_volume(tmp_path / "v.h5", bare_record(tmp_path, RAMP, (0.1, 0.1, 0.1)))
    with h5py.File(tmp_path / "l.h5", "w") as file:
        file["entry/data/labels"] = (RAMP[:, 2:6, 3:7] > 100).astype(np.int32)
        for name, first, n in (("z", -0.25, 6), ("y", -0.15, 4), ("x", -0.15, 4)):
            file[f"entry/data/{name}"] = first + 0.1 * np.arange(n)
            file[f"entry/data/{name}"].attrs["units"] = "mm"
    show([tmp_path / "v.h5"], tmp_path / "l.h5")
    found, said = layers[str(tmp_path / "l.h5")]
    np.testing.assert_array_equal(found, RAMP[:, 3, 3:7] > 100)
    np.testing.assert_allclose(said["translate"], (-0.25, -0.15, -0.15))
    np.testing.assert_allclose(said["scale"], (0.1, 0.1, 0.1))
    with h5py.File(tmp_path / "l.h5", "r+") as file:
        del file["entry/data/z"]
    with pytest.raises(
        DataError, match=r"\(6, 4, 4\); expected whole numbers of the shape of the volume, \(6, 8, 10\)"
    ):
        show([tmp_path / "v.h5"], tmp_path / "l.h5")


def test_gaussians_are_points_in_the_same_place(tmp_path: Path, layers: dict[str, Any]) -> None:
    from dataclasses import replace

    record = bare_record(tmp_path, RAMP, (0.2, 0.1, 0.1))
    names = "densities", "density_unit", "pixel_pitch", "source_distances"
    of_views = "view_angles", "view_roll", "view_tilt", "view_shifts", "axis"
    model = {"centres": np.array([[1.0, 2.0, 3.0]]), "widths": np.array([[0.1, 0.2, 0.3]]), "densities": np.ones(1)}
    model |= {name: np.ones(1) for name in (*names, *of_views) if name not in model}
    write_volume(tmp_path / "v.h5", replace(record, model=model))
    show([tmp_path / "v.h5"], None)
    values, said = layers["Gaussians"]
    np.testing.assert_allclose(values * said["scale"][1] + said["translate"][1], [2.0])  # y, the second of z, y, x
    np.testing.assert_allclose(said["size"] * said["scale"][2], [0.4])


def test_without_napari_a_line_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "napari", None)
    with pytest.raises(ConfigError, match=r"pip install \"napari\[all\]\"\.$"):
        show([tmp_path / "v.h5"], None)


def test_labels_of_another_volume_are_refused(tmp_path: Path, layers: dict[str, Any]) -> None:
    np.save(tmp_path / "v.npy", RAMP)
    for name, values in {"a.tif": RAMP[:5].astype(np.uint8), "b.tif": RAMP + 0.5}.items():
        tifffile.imwrite(tmp_path / name, values)
        with pytest.raises(DataError, match=r"expected whole numbers of the shape of the volume, \(6, 8, 10\)"):
            show([tmp_path / "v.npy"], tmp_path / name)
    assert not layers
