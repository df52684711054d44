"""Compile the kernels that this installation lacks, for the processor of this computer, and say how many.

The Dockerfile and splatline.def run it while an image is built, as the user who owns the installation. It compiles
nothing if the compiled kernels that the package brings fit.
"""

from __future__ import annotations

import numpy as np

from recon import Geometry
from recon.methods import by_name, names
from recon.warm_up import counted, warm_up

SHAPE, VIEWS = (24, 32), 12
PARALLEL = Geometry.parallel(np.linspace(0, np.pi, VIEWS, endpoint=False), SHAPE)
CONE = Geometry.cone(np.linspace(0, 2 * np.pi, VIEWS, endpoint=False), SHAPE, 0.01, 100.0, 200.0)


def main() -> None:
    compiled = [0]

    def count(n: int) -> None:
        compiled[0] = n

    with counted(count):
        for name in names():
            for geometry in (PARALLEL, CONE):
                try:
                    warm_up(by_name(name)(), geometry)
                except ValueError as error:  # a method that does not take such projections
                    print(f"{name}: {error}")
    print(f"{compiled[0]} kernels were compiled; the package brought the others.")


if __name__ == "__main__":
    main()
