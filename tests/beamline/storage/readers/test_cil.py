"""The geometry that CIL writes next to projections is that of CIL itself: each point falls on the same pixel."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.storage.readers.open import SourceOptions, open_scan

ANGLES = np.array([0.0, 25, 90, 200])
SHAPE, PITCH, INITIAL = (6, 10), (0.2, 0.25), 15.0
STANDARD = {
    "source/position": (0.0, -20, 0), "rotation_axis/position": (0.0, 0, 0), "detector/position": (0.3, 30, 0.4),
    "detector/direction_x": (1.0, 0, 0), "detector/direction_y": (0.0, 0, 1), "rotation_axis/direction": (0.0, 0, 1),
}  # fmt: skip
Vectors = Mapping[str, tuple[float, ...]]


def write(path: Path, config: Vectors, values: NDArray[np.generic], labels: str, origin: str = "bottom-left") -> Path:
    """A file with the fields that cil.io.NEXUSDataWriter writes."""
    with h5py.File(path, "w") as file:
        file.attrs["creator"] = np.bytes_("NEXUSDataWriter.py")
        data = file.create_dataset("entry1/tomo_entry/data/data", data=values)
        data.attrs.update(data_type="AcquisitionData", pixel_size_h=PITCH[0], panel_origin=origin)
        data.attrs.update(pixel_size_v=PITCH[1] if values.ndim == 3 else PITCH[0])
        data.attrs.update({f"dim{i}": label for i, label in enumerate(labels.split())})
        for name, vector in config.items():
            file[f"entry1/tomo_entry/config/{name}"] = np.array(vector, np.float32)
        angles = file.create_dataset("entry1/tomo_entry/config/angles", data=ANGLES.astype(np.float32))
        angles.attrs.update(angle_unit="degree", initial_angle=INITIAL)
    return path


def cil_pixels(config: Vectors, points: NDArray[np.float64], origin: str) -> NDArray[np.float64]:
    """(row, col) [view, point] by the vectors that CIL makes for ASTRA: from the axis, turned by -angle."""
    axis = np.array(config["rotation_axis/position"])
    v = {name: np.array(vector) - (axis if "/position" in name else 0) for name, vector in config.items()}
    out = []
    for degrees in ANGLES:
        a = np.radians(-INITIAL - degrees)
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        across = turn @ v["detector/direction_x"] * PITCH[0] * (-1 if "right" in origin else 1)
        up = turn @ v["detector/direction_y"] * PITCH[1] * (-1 if "top" in origin else 1)
        end, start = turn @ v["detector/position"], turn @ v.get("source/position", np.zeros(3))
        for point in points:
            ray = turn @ v["ray/direction"] if "ray/direction" in v else point - start
            col, row, _ = np.linalg.solve(np.stack([across, up, -ray], axis=1), point - end)
            out.append((row + (SHAPE[0] - 1) / 2, col + (SHAPE[1] - 1) / 2))
    return np.reshape(out, (len(ANGLES), len(points), 2))


CASES: Mapping[str, tuple[Vectors, str]] = {
    **{f"cone {origin}": (STANDARD, origin) for origin in ("bottom-left", "top-left", "bottom-right", "top-right")},
    "turned about": ({**STANDARD, "detector/direction_x": (-1.0, 0, 0)}, "bottom-left"),
    "upside down": ({**STANDARD, "detector/direction_y": (0.0, 0, -1)}, "bottom-left"),
    "parallel": (
        {
            **{name: vector for name, vector in STANDARD.items() if "source" not in name},
            **{"ray/direction": (0.0, 1, 0), "rotation_axis/position": (0.5, 0, 0)},
        },
        "bottom-left",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_points_fall_on_the_pixels_of_cil(tmp_path: Path, case: str) -> None:
    """By the convention of `recon.base.geometry`, in a volume whose axes are those of the first view's detector."""
    config, origin = CASES[case]
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (7, 3))
    expected = cil_pixels(config, points, origin)
    path = write(tmp_path / "s.nxs", config, np.zeros((6, 4, 10), np.float32), "vertical angle horizontal", origin)
    with open_scan(path) as source:
        assert source.shape == SHAPE and source.axis_col is not None
        angles, axis, cone, pixel = source.table.angles, source.axis_col, source.cone, source.pixel_size_mm
        pitch = source.row_pitch_mm
    assert (pixel, pitch) == PITCH
    across = np.array(config["detector/direction_x"]) * (-1 if "right" in origin else 1)
    up = np.array(config["detector/direction_y"]) * (-1 if "top" in origin else 1)
    x, y, z = points @ across, points[:, 1], points @ up
    theta = angles[:, None]
    u, w = x * np.cos(theta) + y * np.sin(theta), -x * np.sin(theta) + y * np.cos(theta)
    scale = 1.0 if cone is None else cone[1] / (cone[0] + w)
    assert cone == (None if "source/position" not in config else pytest.approx((20, 50)))
    np.testing.assert_allclose(axis + scale * u / pixel, expected[..., 1], atol=1e-4)
    rows = scale * z / pitch + 0 * u
    np.testing.assert_allclose(rows - rows[:, :1], expected[..., 0] - expected[:, :1, 0], atol=1e-4)


def test_a_sinogram_of_cil_and_its_angles_by_name(tmp_path: Path) -> None:
    flat = {
        name: vector[:2]
        for name, vector in CASES["parallel"][0].items()
        if name not in ("detector/direction_y", "rotation_axis/direction")
    }
    values = np.random.default_rng(1).uniform(size=(4, 10)).astype(np.float32)
    path = write(tmp_path / "s.nxs", flat, values, "angle horizontal")
    named = {"data_path": "entry1/tomo_entry/data/data", "angles_path": "entry1/tomo_entry/config/angles"}
    for scan in (SourceOptions(path), SourceOptions(path, **named)):  # type: ignore[arg-type]
        with open_scan(scan) as source:
            np.testing.assert_array_equal(source.read(slice(None)), values[:, None])
            np.testing.assert_allclose(np.degrees(source.table.angles), -INITIAL - ANGLES, rtol=1e-6)
            assert source.axis_col == pytest.approx(4.5 + (0.5 - 0.3) / PITCH[0])
