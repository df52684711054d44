"""Angles of a table, an array or an HDF5 file are those of a text with one a line, or the file says what to name."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr

from beamline.core.errors import DataError
from beamline.storage.readers.angle_files import load_angles

DEGREES = np.array([0.0, 2.5, 90.25, 179.5])
RADIANS = np.radians(DEGREES)


def table(head: str, row: str, *, comma: bool = False) -> str:
    rows = [row.format(i=i, deg=deg, rad=float(np.radians(deg))) for i, deg in enumerate(DEGREES)]
    return "\n".join([head, *(text.replace(".", ",") if comma else text for text in rows)]).lstrip("\n")


TABLES = {
    "comma": (table("frame,theta", "{i},{deg}"), ""),
    "semicolon": (table("frame;Angle [deg]", "{i};{deg}", comma=True), ""),
    "tab": (table("No\tRotation (rad)", "{i}\t{rad}"), ""),
    "blanks": (table("frame theta_deg time", "{i} {deg} 7"), ""),
    "comment": (table("# frame, angle", "{i}, {deg}"), ""),
    "quoted": (table('"No","angle"', '"{i}","{deg}"'), ""),
    "index": (table(",omega", "{i},{deg}"), ""),
    "one": (table("theta", "{deg}"), ""),
    "named": (table("theta_set,theta_read", "{i},{deg}"), "::theta_read"),
    "number": (table("", "{i},{deg}"), "::1"),
    "plain": (table("# angles in radians or not", "{deg}"), ""),
}


@pytest.mark.parametrize("name", TABLES)
def test_the_angles_of_a_table_are_in_the_column_that_is_named_so(tmp_path: Path, name: str) -> None:
    text, column = TABLES[name]
    (tmp_path / "a.csv").write_text(text)
    np.testing.assert_allclose(load_angles(f"{tmp_path / 'a.csv'}{column}"), RADIANS, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "column", "message"),
    [
        (table("theta_set,theta_read", "{i},{deg}"), "", "columns are theta_set, theta_read; .* FILE::COLUMN"),
        (table("frame,pos", "{i},{deg}"), "", "columns are frame, pos; .* FILE::COLUMN"),
        (table("frame,theta", "{i},{deg}"), "::omega", "columns are frame, theta"),
        (table("", "{i},{deg}"), "::2", "columns are 2 without names"),
        (table("", "{i},{deg}"), "", "number of a view and its angle.* FILE::COLUMN"),
        (table("frame,theta [turns]", "{i},{deg}"), "", "unit of its angles is 'turns'; say --angles-unit"),
        ("frame,theta\n0,0\n1,\n2,4", "", r"line 3 holds '\(empty\)'"),
        ("0 deg\n2 deg", "", "line 1 holds '0 deg'"),
        ("0.5°\n2.5°", "", "line 1 holds '0.5°'"),
    ],
)
def test_a_table_that_may_be_read_otherwise_is_refused(tmp_path: Path, text: str, column: str, message: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DataError, match=message):
        load_angles(f"{tmp_path / 'a.csv'}{column}")


def test_arrays_are_degrees_or_what_they_or_the_caller_say(tmp_path: Path) -> None:
    np.save(tmp_path / "deg.npy", DEGREES)
    np.save(tmp_path / "rad.npy", RADIANS[:, None])
    zarr.open_group(tmp_path / "z.zarr", mode="w").create_array("a/b", data=DEGREES)
    with h5py.File(tmp_path / "one.h5", "w") as file:
        file["theta"], file["count"] = RADIANS, np.arange(4.0)
        file["theta"].attrs["units"] = "rad"
    for name, unit in (("deg.npy", None), ("rad.npy", "rad"), ("z.zarr::a/b", None), ("one.h5", None)):
        np.testing.assert_allclose(load_angles(tmp_path / name, unit), RADIANS)
    np.testing.assert_allclose(load_angles(f"{tmp_path / 'one.h5'}::/count", "rad"), np.arange(4.0))
    with pytest.raises(DataError, match=r"/count in .* has no units attribute"):
        load_angles(f"{tmp_path / 'one.h5'}::/count")
    with h5py.File(tmp_path / "one.h5", "r+") as file:
        file["count"].attrs["units"] = "deg"
    with pytest.raises(DataError, match=r"has 2 lists in a unit of angles. It has .* --angles FILE::DATASET"):
        load_angles(tmp_path / "one.h5")
