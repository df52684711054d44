"""Volume files and checkpoints: complete or absent, overwritten only on request, and everything is read back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from beamline.core.errors import DataError
from beamline.core.files import atomic_file
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers import recon_file as checkpoint_file
from beamline.storage.writers.recon_file import (
    Checkpoint,
    read_checkpoint,
    read_reconstruction,
    write_checkpoint,
    write_reconstruction,
)
from recon.base.volume import Grid, Volume
from tests.messages import refused


def _record(shape: tuple[int, int, int] = (3, 4, 5), voxel: float = 0.25) -> ReconRecord:
    data = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    return ReconRecord(
        volume=Volume(data, Grid(shape, voxel, (0.5, 0.0, -1.0))),
        length_unit="mm",
        raw_file="scan.h5",
        title="a test",
        sample="battery",
        time=1795150000.0,
        parameters={"axis_col": 85.75, "views": np.array([0, 2, 4]), "method": "r2", "seed": 3, "densify": True},
        metrics={"psnr": 31.5},
        history={"step": np.array([0, 10]), "loss": np.array([1.0, 0.5])},
    )


def test_follows_nxtomoproc(tmp_path: Path) -> None:
    """Paths and classes as the NXtomoproc definition lists them."""
    write_reconstruction(tmp_path / "out.h5", _record())
    with h5py.File(tmp_path / "out.h5") as file:
        classes = {
            "entry": "NXentry",
            "entry/instrument": "NXinstrument",
            "entry/instrument/source": "NXsource",
            "entry/sample": "NXsample",
            "entry/reconstruction": "NXprocess",
            "entry/reconstruction/parameters": "NXparameters",
            "entry/data": "NXdata",
        }
        assert {path: file[path].attrs["NX_class"] for path in classes} == classes
        assert file["entry/definition"].asstr()[()] == "NXtomoproc"
        assert file["entry/reconstruction/parameters/raw_file"].asstr()[()] == "scan.h5"
        assert file["entry/reconstruction/date"].asstr()[()] == "2026-11-20T04:46:40+00:00"
        data = file["entry/data/data"]
        assert (data.dtype, data.shape, data.attrs["units"]) == (np.float32, (3, 4, 5), "1/mm")
        assert list(file["entry/data"].attrs["axes"]) == ["z", "y", "x"]
        np.testing.assert_allclose(file["entry/data/z"][:], 0.5 + 0.25 * np.array([-1, 0, 1]))
        assert file["entry/data/x"].attrs["units"] == "mm"


@given(
    shape=st.tuples(*[st.integers(1, 4)] * 3),
    voxel=st.floats(1e-4, 10),
)
@settings(max_examples=10, deadline=None)
def test_everything_comes_back(
    tmp_path_factory: pytest.TempPathFactory, shape: tuple[int, int, int], voxel: float
) -> None:
    path = tmp_path_factory.mktemp("recon") / "out.h5"
    written = _record(shape, voxel)
    write_reconstruction(path, written)
    read = read_reconstruction(path)
    np.testing.assert_array_equal(read.volume.data, written.volume.data)
    assert read.volume.grid.centre == pytest.approx(written.volume.grid.centre)
    if max(shape) > 1:
        assert read.volume.grid.voxel_size == pytest.approx(voxel)
    np.testing.assert_array_equal(read.parameters["views"], [0, 2, 4])
    scalars = ("axis_col", "method", "seed", "densify")
    assert {k: read.parameters[k] for k in scalars} == {k: written.parameters[k] for k in scalars}
    assert read.metrics == written.metrics
    np.testing.assert_array_equal(read.history["loss"], [1.0, 0.5])
    assert (read.raw_file, read.title, read.sample, read.time) == ("scan.h5", "a test", "battery", written.time)


def test_refuses_a_file_that_appeared_meanwhile(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    with refused(DataError), atomic_file(path) as partial:
        partial.write_text("ours")
        path.write_text("theirs")
    assert path.read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [path]


def test_replaces_in_one_step_when_asked_but_no_file_that_the_system_does_not_let_go_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Windows does not of one that a viewer holds open."""
    path = tmp_path / "snapshot.h5"
    for title in ("old", "newer"):
        write_reconstruction(path, replace(_record(), title=title), replace=True)
    held = Mock(side_effect=PermissionError(13, "it is being used by another process"))
    monkeypatch.setattr(Path, "replace", held)
    with pytest.raises(DataError, match=r"another process.*the existing file was not changed"):
        write_reconstruction(path, _record(), replace=True)
    assert read_reconstruction(path).title == "newer"
    assert list(tmp_path.iterdir()) == [path]


def test_other_files_and_missing_folders_are_refused(tmp_path: Path) -> None:
    with refused(DataError):
        write_reconstruction(tmp_path / "no" / "out.h5", _record())
    (tmp_path / "text.h5").write_text("no HDF5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["entry/data/data"] = np.zeros((2, 2, 2))
    expected = {"text.h5": "as a reconstruction", "other.h5": "as a reconstruction", "missing.h5": "does not exist"}
    for name, said in expected.items():
        with pytest.raises(DataError, match=said):
            read_reconstruction(tmp_path / name)


def test_damaged_voxels_are_said_to_be(tmp_path: Path) -> None:
    path, values = tmp_path / "v.h5", _record().volume.data
    write_reconstruction(path, _record())
    with h5py.File(path, "a") as file:
        del file["entry/data/data"]
        stored = file["entry/data"].create_dataset("data", data=values, chunks=(1, 4, 5), fletcher32=True)
        at = stored.id.get_chunk_info(1).byte_offset
    raw = bytearray(path.read_bytes())
    raw[at + 7] ^= 1
    path.write_bytes(raw)
    with refused(DataError):
        read_reconstruction(path)


KEPT = Checkpoint(
    {"parameters.raw": np.arange(4, dtype=np.float32), "generator": np.array([2**64 - 1, 3], np.uint64)},
    {"projections": "ab12", "n_views": 30, "pixel_pitch": np.asarray(0.5), "angles": np.linspace(0, 3, 30)},
    500,
)


@given(
    hnp.arrays(st.sampled_from([np.float32, np.int64, np.uint64]), hnp.array_shapes(max_dims=2, max_side=4)),
    st.integers(0, 10**9),
)
def test_there_and_back_to_the_bit(tmp_path_factory: pytest.TempPathFactory, values: np.ndarray, steps: int) -> None:
    path = tmp_path_factory.mktemp("kept") / "fit.h5"
    write_checkpoint(path, Checkpoint({"a": values, "none": np.empty(0, np.int64)}, KEPT.made_from, steps))
    back = read_checkpoint(path)
    assert back.state["a"].dtype == values.dtype and back.state["a"].tobytes() == values.tobytes()
    assert back.state["none"].shape == (0,) and back.steps == steps
    assert back.made_from["projections"] == "ab12" and back.made_from["n_views"] == 30
    np.testing.assert_array_equal(back.made_from["angles"], KEPT.made_from["angles"])


def test_the_new_one_takes_the_place_of_the_old_one_unless_it_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_checkpoint(tmp_path / "fit.h5", KEPT)
    for error in (OSError(28, "No space left on device"), KeyboardInterrupt()):
        with monkeypatch.context() as patch, pytest.raises((DataError, KeyboardInterrupt)):
            patch.setattr(checkpoint_file, "version", Mock(side_effect=error))
            write_checkpoint(tmp_path / "fit.h5", Checkpoint({}, {}, 7))
        assert read_checkpoint(tmp_path / "fit.h5").steps == 500
    write_checkpoint(tmp_path / "fit.h5", Checkpoint({}, {}, 7))
    assert read_checkpoint(tmp_path / "fit.h5").steps == 7
    assert [p.name for p in tmp_path.iterdir()] == ["fit.h5"]


def test_what_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_text("words")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["volume"] = 1
    with h5py.File(tmp_path / "half.h5", "w") as file:
        file.attrs["format"] = "splatline checkpoint 1"
    for name in ("missing.h5", "text.h5", "other.h5", "half.h5"):
        with pytest.raises(DataError, match=name):
            read_checkpoint(tmp_path / name)
