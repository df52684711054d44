"""Files: the keys of a scene for a volume of voxels, and the sample that they give.

phantom:
  kind: volume
  file: thorax.nii.gz              # .tif, .npy, .npz, .nii(.gz) or .h5, beside the scene file or by its full path
  voxel_mm: 0.01                   # where the file does not state it, or to scale the sample
  window: [-1000, 1500]            # the file's values for no attenuation and the largest
  attenuation_max: 4.0             # 1/mm at the window's upper end; or largest_line_integral: 2.5
  thresholds: [-200, 300]          # the file's values at which labels begin
  names: [tissue, bone]
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulators.frame.mapping import Positive
from simulators.frame.shot import Detector, Pose
from simulators.samples.sample import ReadVolume, Stored
from simulators.samples.voxels.voxels import Voxels

MOST_COLUMNS = 100_000
VIEWS = 8  # Views over half a turn in which the largest line integral is searched


@dataclass(frozen=True)
class VolumeSettings:
    """Values of the file become attenuation linearly: (value - low) times a factor, clipped to the window.

    Attributes:
        file: path; see ReadVolume.
        dataset: path in an HDF5 file, name in an .npz; needed where there is more than one volume.
        axes: the file's order of axes.
        voxel_mm: from voxel to voxel; None: as in the file.
        window: file's values (low, high) for 0 and the largest attenuation; None: low is 0, nothing is clipped.
        scale: the factor itself, 1/mm per unit of the file.
        attenuation_max: 1/mm of the window's upper end, or of the largest value.
        largest_line_integral: dimensionless, over all rays of 8 views, a voxel apart.
        thresholds: file's values, ascending, at which labels 1, 2, ... begin.
        labels: a file of labels 0 ... 255 of the same shape, instead of thresholds; `labels_dataset` in it.
        names: of the labels.
    """

    file: str
    dataset: str | None = None
    axes: str = "zyx"
    voxel_mm: Positive | None = None
    window: tuple[float, float] | None = None
    scale: Positive | None = None
    attenuation_max: Positive | None = None
    largest_line_integral: Positive | None = None
    thresholds: tuple[float, ...] = ()
    labels: str | None = None
    labels_dataset: str | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if sorted(self.axes) != ["x", "y", "z"]:
            raise ValueError(f"axes must name x, y and z in the file's order, got {self.axes!r}")
        if self.window is not None and not self.window[0] < self.window[1]:
            raise ValueError(f"window must be (low, high) in the file's values, got {self.window}")
        factors = ("scale", "attenuation_max", "largest_line_integral")
        given = [name for name in factors if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} exclude each other; give one of them")
        if self.window is not None and not given:
            raise ValueError("a window needs attenuation_max, largest_line_integral or scale")


def volume_sample(settings: VolumeSettings, read: ReadVolume) -> Voxels:
    """The sample of the settings.

    Raises:
        ValueError: the file holds no volume, or a volume that does not fit the settings.
    """
    stored = read(settings.file, settings.dataset)
    values = _turned(stored.values, settings)
    labels = None
    if settings.labels is not None:
        labels = _turned(read(settings.labels, settings.labels_dataset).values, settings)
    spacing = _spacing(stored, settings)
    low, high = settings.window or (0.0, math.inf)
    # float32 throughout: a volume is the largest array of a scene.
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
        raise ValueError("voxel_mm is missing, and the file does not state the size of its voxels")
    own = stored.spacing or (1.0, 1.0, 1.0)
    z, y, x = (own[settings.axes.index(axis)] for axis in "zyx")
    # voxel_mm is the voxel's width; the ratio of width to height is that in the file.
    factor = 1.0 if settings.voxel_mm is None else settings.voxel_mm / x
    return z * factor, y * factor, x * factor


def _factor(values: NDArray[np.float32], spacing: tuple[float, float, float], settings: VolumeSettings) -> float:
    """Factor from values to attenuation in 1/mm."""
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
                f"voxels of {spacing[2]:g} x {spacing[1]:g} mm are too anisotropic for largest_line_integral; give "
                "attenuation_max"
            )
        detector = Detector.centred((planes, across), pitch)
        # Each row projects one plane of voxels, at any distance between planes. Sums between planes are not larger.
        shift = np.zeros((planes, 3))
        shift[:, 2] = detector.v() * (1 - spacing[0] / pitch)
        poses = (Pose.turned(k * math.pi / VIEWS, planes).shifted_by(shift) for k in range(VIEWS))
        most = max(float(whole.line_integrals(pose, detector).max()) for pose in poses)
        if not most > 0:
            raise ValueError(f"largest_line_integral needs matter; the largest sum is {most:g}")
        return settings.largest_line_integral / most
    return 1.0
