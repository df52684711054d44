"""Quality of a volume: PSNR, SSIM and NRMSE with a ground truth; SNR and CNR without one."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_WINDOW, _SIGMA = 11, 1.5
_SAMPLE = 100_000  # number of voxels from which the two cluster centres are computed
_REFERENCE_BLUR = 1.0  # blur of a reference in voxels, so that its noise does not decide which voxels are dense
_SLAB = 32  # number of slices at a time
_MOST_VOXELS = 2**21  # largest number of voxels from which regions and their noise are computed
SUMMED_VALUES = 2**22  # number of values whose errors are summed at a time
_RIM_WIDTH = 2  # width in voxels of the rim of a region, into which the surroundings are blurred

Array = NDArray[np.floating]


def _same_shape(truth: Array, volume: Array) -> None:
    if truth.shape != volume.shape or truth.size == 0:
        raise ValueError(
            f"the ground truth has shape {truth.shape}, the volume {volume.shape}; both must have the same shape"
        )


def psnr(truth: Array, volume: Array, peak: float | None = None) -> float:
    """Peak signal-to-noise ratio, 10 log₁₀(peak² / mean squared error) in dB; inf for equal volumes.

    Args:
        truth, volume: the same shape, any number of dimensions.
        peak: the value of peak in the formula; None: the maximum of the ground truth.
    """
    _same_shape(truth, volume)
    top = float(truth.max()) if peak is None else peak
    if not top > 0:
        raise ValueError(
            f"the peak must be positive, got {top}; state the peak if the ground truth has no positive value"
        )
    error = _squared_error(truth, volume) / truth.size
    return float(10 * np.log10(top**2 / error)) if error else float("inf")


def _squared_error(truth: Array, volume: Array) -> float:
    step = max(1, SUMMED_VALUES * len(truth) // truth.size)
    parts = (slice(first, first + step) for first in range(0, len(truth), step))
    return sum(float(np.sum(np.subtract(volume[p], truth[p], dtype=np.float64) ** 2)) for p in parts)


def nrmse(truth: Array, volume: Array) -> float:
    """Root mean squared error divided by the root mean square of the ground truth: ‖volume - truth‖ / ‖truth‖."""
    _same_shape(truth, volume)
    norm = np.sqrt(_squared_error(np.broadcast_to(truth.dtype.type(0), truth.shape), truth))
    if norm == 0:
        raise ValueError("a relative error is not defined, because the ground truth is zero everywhere")
    return float(np.sqrt(_squared_error(truth, volume)) / norm)


def _data_range(truth: Array, data_range: float | None) -> float:
    span = float(truth.max() - truth.min()) if data_range is None else data_range
    if not span > 0:
        raise ValueError(
            f"the data range must be positive, got {span}; state the data range if the ground truth is constant"
        )
    return span


def _ssim_sum(x: Array, y: Array, span: float, plane: tuple[int, int]) -> tuple[float, int]:
    """Sum of the local SSIM over windows in the plane (two axes), and the number of windows."""

    def blur(image: Array) -> Array:
        for axis in plane:
            image = ndimage.gaussian_filter1d(image, _SIGMA, axis=axis, radius=_WINDOW // 2)
        return image

    c1, c2 = (0.01 * span) ** 2, (0.03 * span) ** 2
    # Subtract the means first, because E[x²] - E[x]² of values far from zero would be rounding noise.
    base_x, base_y = x.mean(), y.mean()
    x, y = x - base_x, y - base_y
    mean_x, mean_y = blur(x), blur(y)
    covariance = blur(x * y) - mean_x * mean_y
    variances = blur(x * x + y * y) - (mean_x**2 + mean_y**2)
    mean_x, mean_y = mean_x + base_x, mean_y + base_y
    local = (2 * mean_x * mean_y + c1) * (2 * covariance + c2) / ((mean_x**2 + mean_y**2 + c1) * (variances + c2))
    inner = [slice(None)] * x.ndim
    for axis in plane:
        if x.shape[axis] >= _WINDOW:
            inner[axis] = slice(_WINDOW // 2, x.shape[axis] - _WINDOW // 2)
    local = local[tuple(inner)]
    return float(local.sum(dtype=np.float64)), local.size


def ssim2d(truth: Array, image: Array, data_range: float | None = None) -> float:
    """Mean structural similarity of two images (Wang et al. 2004, eq. 13), 1 for equal ones.

    Gaussian window of 11 x 11 with σ = 1.5, K1 = 0.01, K2 = 0.03, variances without Bessel's correction, and the mean
    over windows inside the image. If an axis is shorter than the window, the image is mirrored along it.

    Args:
        truth, image: [row, col].
        data_range: None: maximum - minimum of the truth.
    """
    _same_shape(truth, image)
    if truth.ndim != 2:
        raise ValueError(f"images must be [row, col], got shape {truth.shape}")
    total, count = _ssim_sum(
        np.asarray(truth, np.float64), np.asarray(image, np.float64), _data_range(truth, data_range), (0, 1)
    )
    return total / count


def ssim3d(truth: Array, volume: Array, data_range: float | None = None) -> float:
    """Mean `ssim2d` of the slices across each of the three axes, averaged over the axes.

    Args:
        truth, volume: [z, y, x].
        data_range: one value for all slices; None: maximum - minimum of the whole ground truth.
    """
    _same_shape(truth, volume)
    if truth.ndim != 3:
        raise ValueError(f"volumes must be [z, y, x], got shape {truth.shape}")
    span = _data_range(truth, data_range)
    means = []
    for across in range(3):
        first, second = np.moveaxis(truth, across, 0), np.moveaxis(volume, across, 0)
        total, count = 0.0, 0
        for start in range(0, len(first), _SLAB):
            part = slice(start, start + _SLAB)
            x, y = (np.ascontiguousarray(v[part], np.float32) for v in (first, second))
            slab_total, slab_count = _ssim_sum(x, y, span, (1, 2))
            total, count = total + slab_total, count + slab_count
        means.append(total / count)
    return float(np.mean(means))


def ssim_of_whole_slices(truth: Array, volume: Array) -> float:
    """SSIM with each slice as one window, from its mean, variance and covariance (Wang et al. 2004, eq. 13).

    Args:
        truth, volume: [z, y, x]; the data range is that of the whole ground truth.
    """
    _same_shape(truth, volume)
    span = _data_range(truth, None)
    c1, c2 = (0.01 * span) ** 2, (0.03 * span) ** 2
    means = []
    for across in range(3):
        by_slice = []
        for first, second in zip(np.moveaxis(truth, across, 0), np.moveaxis(volume, across, 0), strict=True):
            x, y = np.asarray(first, np.float64), np.asarray(second, np.float64)
            covariance = ((x - x.mean()) * (y - y.mean())).mean()
            luminance = (2 * x.mean() * y.mean() + c1) / (x.mean() ** 2 + y.mean() ** 2 + c1)
            by_slice.append(luminance * (2 * covariance + c2) / (x.var() + y.var() + c2))
        means.append(np.mean(by_slice))
    return float(np.mean(means))


def sampled(volume: Array) -> Array:
    """Every k-th voxel along each axis (a numpy view), so that at most 2^21 voxels remain."""
    steps = [1, 1, 1]
    while np.prod([-(-n // step) for n, step in zip(volume.shape, steps, strict=True)]) > _MOST_VOXELS:
        steps[int(np.argmax(np.divide(volume.shape, steps)))] += 1
    return volume[:: steps[0], :: steps[1], :: steps[2]]


def inscribed_cuboid(shape: tuple[int, int, int], margin: float = 0.1) -> tuple[slice, slice, slice]:
    """The largest box inside the cylinder that every projection sees, minus a margin: (z, y, x) slices.

    The side is 2 r cos 45°, with r half the smaller of ny and nx. The margin is the fraction of the side, and of the
    height, that is removed at each end.
    """
    if not 0 <= margin < 0.5:
        raise ValueError(f"the margin must be a fraction of the side length, 0 to 0.5, got {margin}")
    nz, ny, nx = shape
    side = min(ny, nx) * np.cos(np.pi / 4)
    halves = (nz / 2 * (1 - 2 * margin), side / 2 * (1 - 2 * margin), side / 2 * (1 - 2 * margin))
    return tuple(  # type: ignore[return-value]
        slice(int(np.floor(n / 2 - min(half, n / 2))), int(np.ceil(n / 2 + min(half, n / 2))))
        for n, half in zip(shape, halves, strict=True)
    )


def kmeans_mask(volume: Array, seed: int = 0) -> NDArray[np.int8]:
    """Dense and empty regions by k-means with k = 2 on the voxel values, within the inscribed cuboid.

    The values are divided into two parts so that the sum of squares within the parts is smallest (Otsu 1979, IEEE
    Trans. Syst. Man Cybern. 9, 62). Lloyd's iterations, the usual algorithm for k-means, might end in another division.

    Args:
        volume: [z, y, x], with enough contrast to separate the two regions. The mask also serves for other volumes of
        the same sample.
        seed: seed for the sample of voxels.

    Returns:
        int8 [z, y, x]: 1 dense, 0 empty, -1 outside the cuboid (not used).

    Raises:
        ValueError: all voxels have the same value, or some are not finite.
    """
    box = inscribed_cuboid(volume.shape)
    values = volume[box]
    if not np.isfinite(values).all():
        raise ValueError("the volume contains NaN or infinite values")
    rng = np.random.default_rng(seed)
    sample_indices = tuple(rng.integers(0, n, _SAMPLE) for n in values.shape) if values.size > _SAMPLE else ...
    sample = np.asarray(values[sample_indices], np.float64).ravel()
    if np.ptp(sample) == 0:
        raise ValueError(
            f"all voxels have the value {sample[0]:g}, so there are no two regions that a threshold could separate"
        )
    threshold = _between_two_means(sample)
    mask = np.full(volume.shape, -1, np.int8)
    mask[box] = values > threshold
    return mask


def _between_two_means(values: NDArray[np.float64]) -> float:
    """The threshold: the values are divided into two parts so that the sum of squares within the parts is smallest; the
    threshold is the middle between the means of the two parts."""
    rising = np.sort(values)
    lower = np.arange(1, rising.size)  # number of values in the lower part, for each possible threshold
    mean_below = np.cumsum(rising)[:-1] / lower
    mean_above = (rising.sum() - mean_below * lower) / (rising.size - lower)
    best = int(np.argmax(lower * (rising.size - lower) * (mean_above - mean_below) ** 2))
    return float(mean_below[best] + mean_above[best]) / 2


def interior_regions(reference: Array, seed: int = 0) -> NDArray[np.int8] | None:
    """Dense and empty regions of a volume, without their rims. They can be used to assess any volume of the same
    sample.

    The reference is blurred by a voxel and divided by `kmeans_mask`. Then two voxels are removed at each edge between
    the regions; a region that is too thin for that loses one voxel. So the result depends neither on the noise of the
    reference nor on the exact position of its edges. References with noise, with streaks, or with an axis that is wrong
    by a pixel give the same SNR and CNR within about 0.3 dB.

    Args:
        reference: [z, y, x].
        seed: as in `kmeans_mask`.

    Returns:
        The values of `kmeans_mask`, with -1 also at rims. None if a region has no interior, or if the reference has no
        contrast.
    """
    try:
        mask = kmeans_mask(ndimage.gaussian_filter(np.asarray(reference, np.float32), _REFERENCE_BLUR), seed)
    except ValueError:
        return None
    cross = ndimage.generate_binary_structure(3, 1)
    for rim in range(_RIM_WIDTH, 0, -1):
        inner = np.full(mask.shape, -1, np.int8)
        for kind in (0, 1):
            # The border of the cuboid does not count as an edge of a region.
            near_other = ndimage.binary_dilation(mask == 1 - kind, cross, rim)
            inner[(mask == kind) & ~near_other] = kind
        if all((inner == kind).any() for kind in (0, 1)):
            return inner
    return None


def snr_cnr(volume: Array, mask: NDArray[np.int8] | NDArray[np.bool_]) -> tuple[float, float]:
    """Signal-to-noise and contrast-to-noise ratio in dB: 20 log₁₀(μ / σ_b) and 20 log₁₀(|μ - μ_b| / σ_b).

    μ is the mean of the dense region; μ_b and σ_b are mean and standard deviation of the empty region. A ratio is inf
    if σ_b is 0, and -inf if its numerator is not positive.

    Args:
        volume: [z, y, x].
        mask: 1 (True) dense, 0 (False) empty, -1 not used; see `kmeans_mask`.

    Raises:
        ValueError: the shapes differ, a region has no voxels, or some of its voxels are not finite.
    """
    if volume.shape != mask.shape:
        raise ValueError(f"the volume and the mask must have the same shape, got {volume.shape} and {mask.shape}")
    dense, empty = (volume[mask == kind] for kind in (1, 0))
    if not dense.size or not empty.size:
        raise ValueError(
            f"the mask marks {dense.size} dense and {empty.size} empty voxels; at least one dense and one empty "
            "voxel are needed"
        )
    with np.errstate(invalid="ignore"):
        mean, base = (float(each.mean(dtype=np.float64)) for each in (dense, empty))
        spread = float(empty.std(dtype=np.float64))
    if not (math.isfinite(mean) and math.isfinite(spread)):
        raise ValueError("the volume contains NaN or infinite values")

    def decibel(signal: float) -> float:
        if not signal > 0:
            return float("-inf")
        return float(20 * np.log10(signal / spread)) if spread else float("inf")

    return decibel(mean), decibel(abs(mean - base))
