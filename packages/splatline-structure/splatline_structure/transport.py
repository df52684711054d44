"""Transport through a material: the share that connects two faces, and the tortuosity factor."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import cg

from splatline_structure.materials import Mask, Spacing

_CLOSE = 1e-5  # residual of the solution, relative


def connecting(mask: Mask, axis: int) -> Mask:
    """The parts of a material that reach from one face across `axis` to the other one, by faces of voxels."""
    parts, _ = ndimage.label(mask)
    ends = np.moveaxis(parts, axis, 0)
    both = np.intersect1d(ends[0], ends[-1])
    return np.isin(parts, both[both > 0])


def tortuosity(mask: Mask, axis: int, spacing: Spacing = (1, 1, 1)) -> float:
    """Tortuosity factor along `axis`: share of the material over its relative diffusivity (Cooper et al. 2016).

    Laplace's equation in the material, with a difference of 1 between the two faces and no flux elsewhere, by
    conjugate gradients with the diagonal as preconditioner. Two voxels conduct as the area between them over their
    distance, relative to those along `axis`.

    Args:
        spacing: edges of a voxel (z, y, x).

    Returns:
        1 for a straight channel; infinity where nothing connects the faces.
    """
    through = np.moveaxis(connecting(mask, axis), axis, 0)
    n, length = int(through.sum()), through.shape[0]
    if not n:
        return math.inf
    number = np.full(through.shape, -1, np.int32)
    number[through] = np.arange(n)
    ones, others, conducts = [], [], []
    edges = np.r_[spacing[axis], np.delete(spacing, axis)]  # in the order of the axes of `through`
    for d, conductance in enumerate((spacing[axis] / edges) ** 2):
        line = np.moveaxis(number, d, 0)
        both = (line[1:] >= 0) & (line[:-1] >= 0)
        ones.append(line[1:][both])
        others.append(line[:-1][both])
        conducts.append(np.full(others[-1].size, conductance))
    one, other = np.concatenate(ones), np.concatenate(others)
    first, last = number[0][number[0] >= 0], number[-1][number[-1] >= 0]
    links = csr_array((np.tile(np.concatenate(conducts), 2), (np.r_[one, other], np.r_[other, one])), (n, n))
    diagonal = links.sum(axis=1) + 2.0 * np.bincount(np.r_[first, last], minlength=n)  # a face is half a voxel away
    source = np.zeros(n)
    source[first] = 2
    straight = 1 - (np.nonzero(through)[0] + 0.5) / length
    field, _ = cg(diags_array(diagonal) - links, source, straight, rtol=_CLOSE, M=diags_array(1 / diagonal))
    flux = (2 * (1 - field[first]).sum() + 2 * field[last].sum()) / 2
    return float(mask.mean()) / (flux * length / math.prod(through.shape[1:]))
