"""torch is loaded only by Gaussian fits and neural networks, not by methods on voxels."""

import subprocess
import sys
from pathlib import Path

import grimp
import numpy as np
import pytest

from tests.beamline.scans import TwoCylinders, write_exchange

NEED = {
    "recon.splatting.autograd",
    "recon.splatting.finish",  # these hold Gaussians as tensors
    "recon.splatting.gaussians",
    "recon.splatting.splat",
}
"""Modules that may import torch, beside those of `recon.kernels.gpu`."""

LOAD = {
    "beamline/core/machine.py",  # asks for its version, where it is loaded
    "recon/splatting/gaussians.py",
    "recon/splatting/optimise.py",
}
"""Modules that load it by name, so that Ctrl-C waits meanwhile."""

ON_VOXELS = ("fista-tv", "os-sirt-tv", "pnp-dct", "sirt", "sart", "cgls", "asd-pocs")

WITHOUT = """
import sys

class Refused:
    def find_spec(self, name, *_):
        if name == "torch":
            raise ImportError("torch is not needed here")

sys.meta_path.insert(0, Refused())
"""
RUN = """
from beamline.cli.main import main
for line in sys.stdin.read().splitlines():
    if main(line.split(" "), standalone_mode=False):
        sys.exit(line)
"""
SHOW = """
from contextlib import closing
from pathlib import Path
from beamline.features.page.app import page, viewer
from beamline.features.page.serve import open_port, start
from beamline.page.volume import ShownVolume
import beamline.features.page.command, beamline.page.recording
with closing(ShownVolume(Path("fbp.h5"))) as volume:
    start(lambda access: viewer([volume], access), open_port("127.0.0.1", 0)).stop()
"""


def test_modules_that_load_torch_are_these() -> None:
    graph = grimp.build_graph(
        "beamline", "recon", "drivers", "simulators",
        include_external_packages=True, exclude_type_checking_imports=True, cache_dir=None,
    )  # fmt: skip
    found = graph.find_modules_that_directly_import("torch")
    assert {module for module in found if not module.startswith("recon.kernels.gpu")} == NEED
    root = Path(__file__).parents[2]
    sources = [
        path for package in ("beamline", "recon", "drivers", "simulators") for path in root.glob(f"{package}/**/*.py")
    ]
    by_name = {str(path.relative_to(root)) for path in sources if 'loaded("torch' in path.read_text(encoding="utf-8")}
    assert {name for name in by_name if not name.startswith("recon/kernels/gpu")} == LOAD


@pytest.mark.slow
def test_methods_on_voxels_looks_at_files_and_pages_work_without_torch(tmp_path: Path) -> None:
    write_exchange(tmp_path / "scan.h5", TwoCylinders(np.radians(np.arange(0, 180, 12.0)), shape=(1, 40)))
    lines = ["info scan.h5", "validate scan.h5", "recon scan.h5 -m fbp --dry-run", "recon scan.h5 -m fbp -o fbp.h5"]
    lines += [f"recon scan.h5 -m {name} -o {name}.h5 --no-report --iterations 1" for name in ON_VOXELS]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT + RUN + SHOW], input="\n".join([*lines, "info fbp.h5"]), cwd=tmp_path,
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert all((tmp_path / f"{name}.h5").is_file() for name in ("fbp", *ON_VOXELS))
