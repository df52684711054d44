"""Compile the kernels that most tests use, in two processes at once: python -m tests.compile_kernels fits | rest.

Without this, every worker of pytest-xdist would compile the same kernels at the same time if the cache is empty. The
two halves share few kernels. With a full cache it takes some seconds.
"""

import sys
import tempfile

from beamline.cli.main import main
from recon import R2, FistaTv, OsSirtTv
from recon.base.kernel import Kernel
from recon.splatting.settings import FitSettings
from recon.warm_up import warm_up


def fits() -> None:
    warm_up()


def rest() -> None:
    """The simulated instrument with its monitor, voxel methods, and fits with the other kernel."""
    with tempfile.TemporaryDirectory() as folder:
        few = "scan.angles={scheme: fixed, views: 12, start_deg: 0, span_deg: 18}"
        words = ["--no-live", "-o", folder, "--set", few, "--set", "simulation.clock=virtual"]
        main(["scan", "configs/simulated.yaml", *words], standalone_mode=False)
    for method in (FistaTv(), OsSirtTv(), R2(fit=FitSettings(kernel=Kernel.GAUSSIAN))):
        warm_up(method)


if __name__ == "__main__":
    {"fits": fits, "rest": rest}[sys.argv[1]]()
