"""A threading layer that numba lacks is replaced by another one, with a warning."""

import os
import subprocess
import sys

import pytest

_FBP = "import recon, numpy as np; g = recon.Geometry.parallel(np.linspace(0, 3, 8), (2, 8)); "
_FBP += "print(recon.reconstruct(np.ones((8, 2, 8), np.float32), g, 'fbp').volume.data.sum())"


@pytest.mark.slow
def test_a_layer_that_cannot_be_had() -> None:
    def run(**stated: str) -> tuple[str, str]:
        environment = {**os.environ, **stated}
        done = subprocess.run([sys.executable, "-c", _FBP], capture_output=True, text=True, env=environment, check=True)
        return done.stdout, done.stderr

    plain, silent = run()
    assert "NUMBA_THREADING_LAYER" not in silent
    for layer in ("nonsense", "tbb"):
        summed, told = run(NUMBA_THREADING_LAYER=layer)
        assert summed == plain
        assert f"Unset NUMBA_THREADING_LAYER: the layer {layer} is not available" in told or layer == "tbb"
