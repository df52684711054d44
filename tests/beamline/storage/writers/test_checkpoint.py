"""Checkpoint files: what went in comes out to the bit; each is whole, and takes the place of the one before."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from beamline.core.errors import DataError
from beamline.storage.writers import recon_file as checkpoint_file
from beamline.storage.writers.recon_file import Checkpoint, read_checkpoint, write_checkpoint

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


def test_the_new_one_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "fit.h5", KEPT)
    write_checkpoint(tmp_path / "fit.h5", Checkpoint({}, {}, 7))
    assert read_checkpoint(tmp_path / "fit.h5").steps == 7
    assert [p.name for p in tmp_path.iterdir()] == ["fit.h5"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_one_that_fails_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    write_checkpoint(tmp_path / "fit.h5", KEPT)

    def fails() -> str:
        raise error

    monkeypatch.setattr(checkpoint_file, "version", fails)
    with pytest.raises((DataError, KeyboardInterrupt)):
        write_checkpoint(tmp_path / "fit.h5", Checkpoint({}, {}, 7))
    assert read_checkpoint(tmp_path / "fit.h5").steps == 500
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


def test_a_flipped_bit_is_refused_or_changes_nothing(tmp_path: Path, rng: np.random.Generator) -> None:
    write_checkpoint(tmp_path / "fit.h5", KEPT)
    whole, refused = (tmp_path / "fit.h5").read_bytes(), 0
    with h5py.File(tmp_path / "fit.h5") as file:
        in_values = [file[f"{name}"].id.get_offset() for name in ("state/parameters.raw", "made_from/angles")]
    for at in [*in_values, *rng.integers(len(whole), size=200).tolist()]:
        flipped = bytearray(whole)
        flipped[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "flipped.h5").write_bytes(flipped)
        try:
            back = read_checkpoint(tmp_path / "flipped.h5")
        except DataError as error:
            refused += 1
            assert "flipped.h5" in str(error)
            continue
        assert at not in in_values
        assert back.steps == KEPT.steps and back.state.keys() == KEPT.state.keys()
        for name, values in KEPT.state.items():
            np.testing.assert_array_equal(back.state[name], values)
        for name, value in KEPT.made_from.items():
            np.testing.assert_array_equal(back.made_from[name], value)
    assert refused > 2
