"""Measured: tables and HDF5 files of energies, their units, and what is no such file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.core.errors import ConfigError, DataError
from beamline.features.xafs.contrast import XafsCurve
from beamline.features.xafs.measured import FileOptions, Radiographs, open_measured, open_series
from beamline.features.xafs.series import Series

ENERGIES = np.linspace(8.3, 8.4, 11)
TRUE = np.linspace(0.2, 1.2, 11)[:, None, None] * np.ones((11, 6, 8))


def _hdf5(path: Path, **content: Any) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in content.items():
            file[name] = values
    return path


def _text(path: Path, content: str) -> Path:
    path.write_text(content, encoding="utf-8")
    return path


def _refused(path: Path, words: str, unit: str | None = None, quantity: str | None = None) -> None:
    with pytest.raises(DataError, match=words), open_measured(path, unit, quantity):
        pass


def _counts() -> dict[str, Any]:
    return {"energy": ENERGIES, "frames": 100 + 9000 * np.exp(-TRUE), "flats": np.full((11, 6, 8), 9100.0),
            "darks": np.full((3, 6, 8), 100.0)}  # fmt: skip


@pytest.mark.parametrize(
    "text",
    [
        "energy,mu\n8.30,1.5\n8.31,1.6\n",
        "# eV; mu\n8.30;1.5;9\n\n8.31; 1.6;9\n",
        "% keV\n8,30;1,5\n8,310;1,6",
        "8,30\t1,5\n8,31\t1,6",
        "8,30  1,5 9\n8,31 1,6 9",
        "8.30, 1.5\n8.31, 1.6",
        "  8.30   1.5\n  8.31\t1.6",
    ],
)
def test_tables_of_any_manner(tmp_path: Path, text: str) -> None:
    with open_measured(_text(tmp_path / "mu.csv", text), None, None) as table:
        assert isinstance(table, XafsCurve)
        assert (table.energies.tolist(), table.absorption.tolist()) == ([8.30, 8.31], [1.5, 1.6])


@pytest.mark.parametrize("value", ["1e300", "-1e31", "1e999"])
def test_an_absorption_that_nothing_has_is_refused(tmp_path: Path, value: str) -> None:
    _refused(_text(tmp_path / "mu.csv", f"8.30 1\n8.31 {value}"), r"absorption .* at 1 energ")
    path = _hdf5(tmp_path / "mu.h5", energy=ENERGIES, mu=np.full(ENERGIES.size, float(value)))
    _refused(path, rf"mu .*{ENERGIES.size} energ")


def test_a_table_in_another_encoding_is_refused_in_our_words(tmp_path: Path) -> None:
    (tmp_path / "mu.csv").write_text("# für µ\n8.30 1\n8.31 2", encoding="latin-1")
    _refused(tmp_path / "mu.csv", r"be read \((?!.*codec).*UTF-8.*UTF-8")


@pytest.mark.parametrize(
    ("unit", "energies", "advice"),
    [
        (None, (0.0083, 0.0084), ""), (None, (8300.0, 8400.0), "; if they are eV, give --unit eV"),
        (None, (8.3, 8300.0), ""), ("eV", (8.3, 8.4), "; if they are keV, give --unit keV"), ("eV", (8e6, 9e6), ""),
    ],
)  # fmt: skip
def test_a_unit_is_advised_only_where_it_makes_the_energies_possible(
    tmp_path: Path, unit: str | None, energies: tuple[float, float], advice: str
) -> None:
    path = _text(tmp_path / "mu.csv", "\n".join(f"{energy} 1" for energy in energies))
    _refused(path, rf"keV are impossible, expected 0\.05 to 500{advice}\.$", unit)


def test_energies_in_ev_are_read_where_it_is_said(tmp_path: Path) -> None:
    (tmp_path / "mu.csv").write_text("8300 1\n8310 2", encoding="utf-8")
    with open_measured(tmp_path / "mu.csv", "eV", None) as table:
        np.testing.assert_allclose(table.energies, [8.3, 8.31])
    _refused(_text(tmp_path / "kev.csv", "8.30 1\n8.31 2"), r"0.0083 to 0.00831.*--unit", "eV")
    _refused(tmp_path / "mu.csv", r"8300 to 8310.*--unit")
    path = _hdf5(tmp_path / "mu.h5", energy=ENERGIES * 1e3, mu=TRUE[:, 0, 0])
    with h5py.File(path, "a") as file:
        file["energy"].attrs["units"] = "eV"
    with open_measured(path, None, None) as table:
        np.testing.assert_allclose(table.energies, ENERGIES)


@pytest.mark.parametrize("flat", ["each", "one"])
def test_counts_become_line_integrals(tmp_path: Path, flat: str) -> None:
    content = _counts() | ({"flats": np.full((6, 8), 9100.0)} if flat == "one" else {})
    with open_measured(_hdf5(tmp_path / "scan.h5", **content), None, None) as found:
        assert isinstance(found, Radiographs)
        for i, (energy, frame) in enumerate(found.line_integrals(range(11))):
            assert energy == ENERGIES[i]
            np.testing.assert_allclose(frame, TRUE[i], rtol=1e-12)


@pytest.mark.parametrize("name", ["frames", "flats", "darks"])
def test_counts_that_are_the_most_a_file_holds_are_not_known(tmp_path: Path, name: str) -> None:
    content = {key: value.astype(np.uint16) if value.ndim > 1 else value for key, value in _counts().items()}
    content[name][2, 3, 4] = 65535
    with open_measured(_hdf5(tmp_path / "scan.h5", **content), None, None) as found:
        assert isinstance(found, Radiographs)
        frames = np.stack([frame for _, frame in found.line_integrals(range(11))])
    lost = np.zeros((11, 6, 8), dtype=bool)
    lost[:, 3, 4] = (np.arange(11) == 2) | (name == "darks")
    np.testing.assert_array_equal(np.isnan(frames), lost)


def test_line_integrals_are_taken_where_it_is_said(tmp_path: Path) -> None:
    with open_measured(_hdf5(tmp_path / "scan.h5", energy=ENERGIES, frames=TRUE), None, "line_integrals") as found:
        assert isinstance(found, Radiographs)
        np.testing.assert_array_equal([frame for _, frame in found.line_integrals([4, 2])], TRUE[[4, 2]])


def test_a_series_is_of_the_range_and_regions_asked_for(tmp_path: Path) -> None:
    content = _counts()
    back = {name: content[name][::-1] for name in ("energy", "frames")}
    path = _hdf5(tmp_path / "scan.h5", **content | back)
    with open_series(path, FileOptions(8.325, 8.365, region=(1, 4, 2, 6), around=(4, 6, 0, 8))) as series:
        assert isinstance(series, Series)
        assert (series.title, series.n) == ("scan.h5", 4)
        np.testing.assert_allclose([energy for energy, _ in series.frames], [8.33, 8.34, 8.35, 8.36])
        assert series.regions.inside.sum() == 12
        assert series.regions.around is not None and series.regions.around.sum() == 16
    with open_series(path, FileOptions(region=(3, 4, 2, 3), around=(2, 5, 2, 3))) as part:
        assert isinstance(part, Series) and part.regions.around is not None
        np.testing.assert_array_equal(np.argwhere(part.regions.inside), [[2, 1]])
        np.testing.assert_array_equal(np.argwhere(part.regions.around), [[1, 1], [3, 1]])  # the material is not around
        assert [frame.shape for _, frame in part.frames] == [(5, 3)] * 11  # no more of a frame is read
    with (
        pytest.raises(ConfigError, match="no pixel outside of"),
        open_series(path, FileOptions(region=(0, 2, 0, 2), around=(0, 1, 0, 1))),
    ):
        pass
    with open_series(path, FileOptions()) as whole:
        assert isinstance(whole, Series) and whole.regions.inside.all() and whole.regions.around is None


def test_a_table_is_a_curve_already(tmp_path: Path) -> None:
    (tmp_path / "mu.txt").write_text("8.32 3\n8.30 1\n8.31 2\n8.4 9", encoding="utf-8")
    with open_series(tmp_path / "mu.txt", FileOptions(high=8.35)) as curve:
        assert isinstance(curve, XafsCurve)
        assert (curve.energies.tolist(), curve.absorption.tolist()) == ([8.30, 8.31, 8.32], [1.0, 2.0, 3.0])
    with (
        pytest.raises(ConfigError, match="has no frames"),
        open_series(tmp_path / "mu.txt", FileOptions(region=(0, 1, 0, 1))),
    ):
        pass


def _without(name: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda content: {key: value for key, value in content.items() if key != name}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_without("energy"), "has no dataset energy"),
        (_without("frames"), "has no dataset frames"),
        (_without("flats"), "may be counts or line integrals. Add flats, or give --quantity line-integrals"),
        (lambda c: c | {"frames": c["frames"][1:]}, r"they must be \[energy, row, col\] of 11"),
        (lambda c: c | {"flats": c["flats"][1:]}, r"flats are \(10, 6, 8\); they must be \(11, 6, 8\) or \(6, 8\)"),
        (lambda c: c | {"darks": np.zeros((6, 9))}, r"darks are \(6, 9\)"),
        (lambda c: c | {"mu": np.ones(4)}, r"mu is \(4,\), but there are 11 energies"),
        (lambda c: c | {"mu": np.full(11, np.nan)}, "mu is not a number at 11 energies"),
        (lambda c: c | {"energy": np.full(11, np.inf)}, "energy is not a number at 11"),
        (lambda c: c | {"energy": np.full(11, b"8.3")}, "energy holds text"),
        (lambda c: c | {"frames": np.zeros((11, 6, 8), dtype="S2")}, "frames holds text"),
        (lambda c: c | {"mu": np.ones(11) + 1j}, "mu holds complex numbers"),
        (lambda c: c | {"frames": np.zeros((11, 0, 8))}, r"frames are \(11, 0, 8\)"),
    ],
)
def test_what_is_no_such_file_is_refused(
    tmp_path: Path, change: Callable[[dict[str, Any]], dict[str, Any]], words: str
) -> None:
    _refused(_hdf5(tmp_path / "scan.h5", **change(_counts())), words)


@pytest.mark.parametrize("table", [True, False])
def test_an_energy_that_is_there_twice_is_named(tmp_path: Path, table: bool) -> None:
    twice = np.where(np.arange(11) == 7, ENERGIES[4], ENERGIES)
    if table:
        path = _text(tmp_path / "mu.csv", "\n".join(f"{e} 1" for e in twice))
    else:
        path = _hdf5(tmp_path / "scan.h5", **_counts() | {"energy": twice})
    with (
        pytest.raises(DataError, match=r"8.34 keV"),
        open_series(path, FileOptions()),
    ):
        pass


def test_a_text_that_says_nan_is_no_comment(tmp_path: Path) -> None:
    path = _text(tmp_path / "mu.csv", "info: nanometres\n8.3 1\nnan 2\nNaN 3")
    _refused(path, "energy is not a number at 2")


def test_a_file_that_is_cut_short_is_told(tmp_path: Path) -> None:
    path = tmp_path / "scan.h5"
    content = _counts()
    with h5py.File(path, "w") as file:
        for name in ("energy", "flats", "darks"):
            file[name] = content[name]
        file.create_dataset("frames", data=content["frames"], chunks=(1, 6, 8), compression="gzip", fletcher32=True)
        at = file["frames"].id.get_chunk_info(9).byte_offset
    with path.open("r+b") as raw:
        raw.seek(at)
        raw.write(bytes(16))
    with open_measured(path, None, None) as found:
        assert isinstance(found, Radiographs)
        frames = found.line_integrals(range(11))
        assert len([next(frames) for _ in range(9)]) == 9
        with pytest.raises(DataError, match=r"scan.h5 cannot be read"):
            next(frames)


def test_other_units_missing_files_and_text_are_refused(tmp_path: Path) -> None:
    path = _hdf5(tmp_path / "scan.h5", **_counts())
    with h5py.File(path, "a") as file:
        file["energy"].attrs["units"] = "nm"
    _refused(path, "energies are in 'nm', which is neither")
    _refused(tmp_path / "none.h5", r"none\.h5")
    _refused(_text(tmp_path / "mu.csv", "8.3 1\n8.4 one"), r"line 2: '8.4 one'")
    with (
        pytest.raises(ConfigError, match="of 6 x 8"),
        open_series(_hdf5(tmp_path / "good.h5", **_counts()), FileOptions(region=(0, 7, 0, 8))),
    ):
        pass


def test_transmission_is_not_taken_for_line_integrals(tmp_path: Path) -> None:
    depth = np.zeros((11, 20, 32))
    depth[:, 5:15, 10:22] = np.linspace(0.5, 1.5, 11)[:, None, None]
    path = _hdf5(tmp_path / "t.h5", energy=ENERGIES, frames=np.exp(-depth).astype(np.float32))
    _refused(path, r"as transmission does.* add flats of 1", quantity="line_integrals")
    with h5py.File(path, "r+") as file:
        file["flats"] = np.ones((20, 32), np.float32)
    with open_measured(path, None, None) as found:
        lines = np.stack([frame for _, frame in found.line_integrals(range(11))])
    np.testing.assert_allclose(lines, depth, atol=1e-5)
