"""Transport through a material: the part that connects two faces, and the tortuosity factor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import LinearOperator, cg, splu

from splatline_structure.materials import F64, Mask, Spacing

_CLOSE = 1e-5  # relative residual at which the solver stops
_BLOCK, _BLOCKS = 4, 24  # shortest edge of a block in voxels; largest number of blocks along the longest side


def connecting(mask: Mask, axis: int) -> Mask:
    """The parts of a material that connect the two faces across `axis`; voxels connect through their faces."""
    parts, _ = ndimage.label(mask)
    ends = np.moveaxis(parts, axis, 0)
    both = np.intersect1d(ends[0], ends[-1])
    return np.isin(parts, both[both > 0])


def tortuosity(mask: Mask, axis: int, spacing: Spacing = (1, 1, 1)) -> float:
    """Tortuosity factor along `axis`: fraction of the material divided by its relative diffusivity (Cooper et al.
    2016).

    Solves Laplace's equation in the material, with a difference of 1 between the two faces and no flux elsewhere, with
    conjugate gradients. The preconditioner is the diagonal plus the exact solution for blocks of voxels, each with one
    value; the diagonal alone needs eleven times as many iterations for a cube of 96 voxels. The conductance between two
    voxels is the area between them divided by their distance, relative to voxels along `axis`.

    Args:
        spacing: edges of a voxel (z, y, x).

    Returns:
        1 for a straight channel; infinity if nothing connects the faces.
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
    from_voxel, to_voxel = np.concatenate(ones), np.concatenate(others)
    first, last = number[0][number[0] >= 0], number[-1][number[-1] >= 0]
    links = csr_array(
        (np.tile(np.concatenate(conducts), 2), (np.r_[from_voxel, to_voxel], np.r_[to_voxel, from_voxel])), (n, n)
    )
    diagonal = links.sum(axis=1) + 2.0 * np.bincount(np.r_[first, last], minlength=n)  # a face is half a voxel away
    source = np.zeros(n)
    source[first] = 2
    straight = 1 - (np.nonzero(through)[0] + 0.5) / length
    laplace = diags_array(diagonal) - links
    block = _blocks_of(through)
    members = csr_array((np.ones(n), block, np.arange(n + 1)))
    of_blocks = splu((members.T @ laplace @ members).tocsc())

    def nearly_solved(residual: F64) -> F64:
        by_blocks = of_blocks.solve(np.bincount(block, residual, members.shape[1]))
        return np.asarray(residual / diagonal + by_blocks[block])

    nearly = LinearOperator(laplace.shape, nearly_solved, dtype=np.float64)
    field, _ = cg(laplace, source, straight, rtol=_CLOSE, M=nearly)
    flux = (2 * (1 - field[first]).sum() + 2 * field[last].sum()) / 2
    return float(mask.mean()) / (flux * length / math.prod(through.shape[1:]))


def _blocks_of(mask: Mask) -> NDArray[np.int64]:
    """The number of the block of each voxel of a mask; blocks without such a voxel get no number."""
    edge = max(_BLOCK, -(-max(mask.shape) // _BLOCKS))
    places = np.ravel_multi_index(tuple(each // edge for each in np.nonzero(mask)), mask.shape)
    return np.asarray((np.cumsum(np.bincount(places) > 0) - 1)[places])
