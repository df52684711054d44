"""Voxel scene: what a scene says of a volume from a file, and the sample that comes of it.

phantom:
  kind: volume
  file: thorax.nii.gz              # .tif, .npy, .npz, .nii(.gz) or .h5, beside the scene file or by its full path
  voxel_mm: 0.01                   # where the file does not say, or to make it smaller
  window: [-1000, 1500]            # the file's values that become nothing and the most
  attenuation_max: 4.0             # 1/mm at the window's upper end; or largest_line_integral: 2.5
  thresholds: [-200, 300]          # the file's values at which labels begin
  names: [tissue, bone]
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulators.frame.detector import Detector
from simulators.frame.pose import Pose
from simulators.samples.voxels.stored import ReadVolume, Stored
from simulators.samples.voxels.voxels import Voxels

MOST_COLUMNS = 100_000
LOOKS = 8
"""Views over half a turn among which the largest line integral is sought."""


@dataclass(frozen=True)
class VolumeSettings:
    """Values of the file become attenuation by a straight line: (value - low) times a factor, kept within the window.

    Attributes:
        file: read by whoever opens the scene.
        dataset: path in an HDF5 file, name in an .npz; needed where there is more than one volume.
        axes: the file's order of axes.
        voxel_mm: from voxel to voxel; None: the file says.
        window: file's values (low, high) that become 0 and the most; None: from 0 on, as it is.
        scale: the factor itself, 1/mm per unit of the file.
        attenuation_max: 1/mm of the window's upper end, or of the largest value.
        largest_line_integral: dimensionless, over all rays of 8 views around, a voxel apart.
        thresholds: file's values, ascending, at which labels 1, 2, ... begin.
        labels: a file of labels 0 ... 255 instead, of the same shape; `labels_dataset` in it.
        names: of the labels.
    """

    file: str
    dataset: str | None = None
    axes: str = "zyx"
    voxel_mm: float | None = None
    window: tuple[float, float] | None = None
    scale: float | None = None
    attenuation_max: float | None = None
    largest_line_integral: float | None = None
    thresholds: tuple[float, ...] = ()
    labels: str | None = None
    labels_dataset: str | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if sorted(self.axes) != ["x", "y", "z"]:
            raise ValueError(f"axes must name x, y and z in the file's order, got {self.axes!r}")
        if self.voxel_mm is not None and not self.voxel_mm > 0:
            raise ValueError(f"voxel_mm must be positive, got {self.voxel_mm}")
        if self.window is not None and not self.window[0] < self.window[1]:
            raise ValueError(f"window must be (low, high) in the file's values, got {self.window}")
        factors = {
            "scale": self.scale,
            "attenuation_max": self.attenuation_max,
            "largest_line_integral": self.largest_line_integral,
        }
        said = {name: value for name, value in factors.items() if value is not None}
        if len(said) > 1:
            raise ValueError(f"{' and '.join(said)} both say how values become attenuation; name one")
        if self.window is not None and not said:
            raise ValueError("a window needs attenuation_max, largest_line_integral or scale")
        if any(not value > 0 for value in said.values()):
            raise ValueError(f"{next(iter(said))} must be positive, got {next(iter(said.values()))}")


def voxels_of(settings: VolumeSettings, read: ReadVolume) -> Voxels:
    """The sample of the settings.

    Raises:
        ValueError: what is read is no volume, or does not go with the settings.
    """
    stored = read(settings.file, settings.dataset)
    values = _turned(stored.values, settings)
    labels = None
    if settings.labels is not None:
        labels = _turned(read(settings.labels, settings.labels_dataset).values, settings)
    spacing = _spacing(stored, settings)
    low, high = settings.window or (0.0, math.inf)
    # float32 throughout: a volume is the largest thing that a scene holds.
    attenuation = values.astype(np.float32)
    if settings.window is not None:
        np.clip(attenuation, low, high, out=attenuation)
        attenuation -= np.float32(low)
    factor = _factor(attenuation, spacing, settings)
    attenuation *= np.float32(factor)
    thresholds = [float(np.float32(np.float32(t) - np.float32(low)) * np.float32(factor)) for t in settings.thresholds]
    return Voxels.of(attenuation, spacing, thresholds, labels, settings.names)


def _turned(values: NDArray[np.generic], settings: VolumeSettings) -> NDArray[np.generic]:
    if values.ndim != 3 or not (np.issubdtype(values.dtype, np.integer) or np.issubdtype(values.dtype, np.floating)):
        raise ValueError(f"a volume has three axes and real values, not the shape {values.shape} of {values.dtype}")
    return values.transpose([settings.axes.index(axis) for axis in "zyx"])


def _spacing(stored: Stored, settings: VolumeSettings) -> tuple[float, float, float]:
    if settings.voxel_mm is None and stored.spacing is None:
        raise ValueError("voxel_mm is missing, and the file does not say the size of its voxels")
    own = stored.spacing or (1.0, 1.0, 1.0)
    z, y, x = (own[settings.axes.index(axis)] for axis in "zyx")
    # A size that is said is the voxel's width; where the file knows the shape of its voxels, they keep it.
    factor = 1.0 if settings.voxel_mm is None else settings.voxel_mm / x
    return z * factor, y * factor, x * factor


def _factor(values: NDArray[np.float32], spacing: tuple[float, float, float], settings: VolumeSettings) -> float:
    """What the values are multiplied by to become attenuation in 1/mm."""
    if settings.scale is not None:
        return settings.scale
    if settings.attenuation_max is not None:
        top = settings.window[1] - settings.window[0] if settings.window else float(values.max())
        if not top > 0:
            raise ValueError(f"attenuation_max needs a value above 0; the largest is {top:g}")
        return settings.attenuation_max / top
    if settings.largest_line_integral is not None:
        whole = Voxels.of(values, spacing)
        pitch, planes = min(spacing[1:]), values.shape[0]
        across = math.ceil(math.hypot(spacing[1] * values.shape[1], spacing[2] * values.shape[2]) / pitch) + 2
        if across > MOST_COLUMNS:
            raise ValueError(
                f"voxels of {spacing[2]:g} x {spacing[1]:g} mm are too unlike for largest_line_integral; give "
                "attenuation_max"
            )
        detector = Detector.centred((planes, across), pitch)
        # Each row sees a plane of voxels, however far apart these are; between two of them no sum is larger.
        shift = np.zeros((planes, 3))
        shift[:, 2] = detector.v() * (1 - spacing[0] / pitch)
        looks = (Pose.turned(k * math.pi / LOOKS, planes).shifted_by(shift) for k in range(LOOKS))
        most = max(float(whole.line_integrals(look, detector).max()) for look in looks)
        if not most > 0:
            raise ValueError(f"largest_line_integral needs matter; the largest sum is {most:g}")
        return settings.largest_line_integral / most
    return 1.0
