"""Bit-identical results: line integrals, volumes and files of real scans and scenes, compared with stored digests.

The commands are those of users, so that the test holds whatever the inside looks like. A digest differs where a bit
does: after a change that must not change results, no digest may differ. Where one was meant to change, say so in
CHANGELOG.md and record all of them anew:

    OPENBLAS_NUM_THREADS=1 python -m tests.beamline.test_same_bits [CASE ...]

Digests are of one environment (versions and processor); elsewhere the test is skipped. Real scans that are not beside
the checkout are skipped one by one.
"""

import hashlib
import json
import os
import platform
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest.mock import patch

import h5py
import llvmlite.binding
import numpy as np
import pytest
import torch
from click.testing import CliRunner

import recon  # noqa: F401 - before numba: it says what processor numba compiles for

# isort: split
import numba

from beamline.cli.main import main
from tests.conftest import SHARED_DATA

RECORD = Path(__file__).with_suffix(".json")
VOLATILE = ("command", "raw_file", "recipe", "seconds", "date", "version", "title", "resumed_from")
"""Beginnings of the names of datasets that differ from call to call or from version to version."""

LENS = "xcenter = 80.2\nycenter = 66.5\nfactor0 = 1.0\nfactor1 = 2e-5\nfactor2 = 1e-7\n"
SMALL = ("detector.shape=[56,72]", "detector.pixel_size_um=18")
DIAMOND = ("diamond_24737_parallel_91x135x160.h5", "--rows", "40:72", "--axis", "85.75")
TOOTH = ("aps2bm_tooth_181x2x640.h5", "--axis", "295.6")
WALNUT = ("walnut_parallel_rebinned_240x96x256.h5", "--quantity", "line-integrals", "--rows", "40:48", "--bin", "2",
          "--axis", "127.5")  # fmt: skip
PAGANIN = ("--phase", "paganin:50", "--distance-mm", "200", "--energy-kev", "30", "--pixel-size-um", "2")


@dataclass(frozen=True)
class Scene:
    """A scene of the package, made small."""

    name: str
    views: int
    settings: tuple[str, ...] = SMALL


WEAR = (
    "effects=[pixel_area, {kind: beam_profile, sigma: [1.6, 0.8], stripes: 0.03, stripe_period: 0.09, drift: 1.0e-4, "
    "wander: [0.0, 1.0e-3]}, {kind: ring_current, lifetime: 360.0, top_up_every: 3.0}, {kind: flat_structure, specks: "
    "200, radius_um: 20.0}, prnu, photon_noise, {kind: hot_pixels, fraction: 2.0e-3, rate: 2000.0, seed: 3}, {kind: "
    "zingers, rate: 50.0}, read_noise, offset]"
)
NOISY = Scene("battery_noisy", 60, (*SMALL, WEAR, "beam.photons_per_s=8.0e+4"))
LOW = Scene("low_dose", 40)
EARLY = Scene("early_acquisition", 180, ("detector.shape=[40,48]", "detector.pixel_size_um=27"))
CONE = Scene("cone_r2", 40, ("detector.shape=[48,64]", "detector.pixel_size_um=44.64"))
FAST = Scene("fast_fly", 48)
PLAIN = Scene("plain", 45, ())

CASES: Mapping[str, tuple[str | Scene, ...]] = {
    "diamond, as it is": DIAMOND[:3],
    "diamond, half the views, rings": (*DIAMOND, "--views", "every:2", "--rings", "vo", "--air", "surface:1"),
    "diamond, turned": (*DIAMOND, "--tilt", "0.5", "--distortion", "lens.txt", "--hardening", "fit"),
    "diamond, tilt sought": (DIAMOND[0], "--tilt", "auto", "--bin", "2"),
    "diamond, phase": (*DIAMOND, *PAGANIN, "--unsharp", "1:0.5", "--rings", "sort", "--air", "12,12"),
    "diamond, phase of turned views in slabs": (*DIAMOND, *PAGANIN, "--tilt", "-0.4", "--memory", "14M"),
    "diamond, followed": (*DIAMOND, "--follow", "--seconds", "0.5", "--tilt", "0.5"),
    "tooth, dynamic flats": (*TOOTH, "--flat-fields", "dynamic", "--rings", "auto"),
    "tooth, counted": (*TOOTH, "--noise", "counts", "--gain", "2", "--views", "every:3", "--references", "accept"),
    "walnut, hardening": (*WALNUT, "--hardening", "C:60kV,Al=1", "--views", "every:2"),
    "walnut, no air": (*WALNUT, "--air", "none", "--rings", "sort"),
    "noisy battery": (NOISY, "--rings", "sort"),
    "noisy battery, dynamic flats": (NOISY, "--flat-fields", "dynamic", "--rows", "8:40"),
    "noisy battery, followed": (NOISY, "--follow", "--seconds", "0.5"),
    "low dose": (LOW,),
    "low dose, logarithm": (LOW, "--noise", "log", "--hardening", "fit"),
    "early acquisition": (EARLY, "--flags", "judge"),
    "early acquisition, followed": (EARLY, "--follow", "--seconds", "0.5"),
    "cone": (CONE, "--axis", "31.5", "--rings", "sort"),
    "fast fly": (FAST, "--tilt", "auto", "--views", "first:40", "--axis", "35.5"),
    "plain": (PLAIN,),
    "plain, in slabs": (PLAIN, "--memory", "12M", "--axis", "79.5", "--rings", "sort"),
}


def environment() -> dict[str, str]:
    """What the bits depend on besides our own code."""
    packages = ("numpy", "scipy", "numba", "torch", "h5py")
    return {
        "python": platform.python_version(),
        "processor": _processor(),
        **{name: version(name) for name in packages},
        "threads of BLAS": os.environ.get("OPENBLAS_NUM_THREADS", "all"),  # 1 in workers of pytest
    }


def _processor() -> str:
    """Its name, a digest of its instructions (machines of several generations call themselves "AMD EPYC"), and the
    level that numba compiles for."""
    instructions = hashlib.sha256(llvmlite.binding.get_host_cpu_features().flatten().encode()).hexdigest()[:8]
    name, level = llvmlite.binding.get_host_cpu_name(), numba.config.CPU_NAME or "itself"
    return f"{platform.system()} {platform.machine()} {name} {instructions}, compiled for {level}"


def digests(case: str, folder: Path) -> dict[str, str]:
    """Digests of what a case makes: its scan, its line integrals, and the datasets of its volume by name.

    On one thread each: sums of matrix products round by the number of threads.
    """
    scan, *options = CASES[case]
    (folder / "lens.txt").write_text(LENS, encoding="utf-8")
    options = [str(folder / option) if option == "lens.txt" else str(option) for option in options]
    path, found = SHARED_DATA / str(scan), dict[str, str]()
    if isinstance(scan, Scene):
        path = folder / "scan.h5"
        words = [word for setting in scan.settings for word in ("--set", setting)]
        _run("simulate", scan.name, "--frames", str(scan.views), "--out", str(path), *words)
        with h5py.File(path) as file:
            found["scan"] = _digest(file["/entry/instrument/detector/data"][()])
    follow = "--follow" in options
    with ExitStack() as spying, _one_thread():
        spying.enter_context(_spied("beamline.reconstruct.pipeline", found))
        method = [] if follow else ["-m", "fbp"]
        _run("recon", str(path), *map(str, (*method, *options)), "--no-report", "-o", str(folder / "out.h5"))
    if not follow:  # how far a fit comes in its time is another thing each time
        with h5py.File(folder / "out.h5") as file:
            file.visititems(lambda name, item: found.update(_of_dataset(name, item)))
    return found


@contextmanager
def _one_thread() -> Iterator[None]:
    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])


def _run(*words: str) -> None:
    result = CliRunner().invoke(main, words, catch_exceptions=False)
    assert result.exit_code == 0, f"beamline {' '.join(words)}: {result.output}"


def _spied(module: str, found: dict[str, str]) -> Any:
    """Notes the line integrals that the module judges its volume by."""
    write = __import__(module, fromlist=["write_result"]).write_result

    def noted(made: Any, *rest: Any) -> Any:
        prepared = made.prepared
        views, apart, geometry = prepared.views.seen, prepared.views.unseen, prepared.geometry
        found["line integrals"] = _digest(views.data)
        found["views"] = _digest(views.ids, geometry.angles, geometry.shifts, np.float64(geometry.axis_col))
        found["weights"] = "" if views.weights is None else _digest(views.weights[...])
        found["held out"] = "" if apart is None else _digest(apart.data)
        return write(made, *rest)

    return patch(f"{module}.write_result", noted)


def _of_dataset(name: str, item: Any) -> dict[str, str]:
    if not isinstance(item, h5py.Dataset) or name.rsplit("/", 1)[-1].startswith(VOLATILE):
        return {}
    value = item[()]
    return {name: hashlib.sha256(value).hexdigest()[:16] if isinstance(value, bytes) else _digest(value)}


def _digest(*arrays: Any) -> str:
    found = hashlib.sha256()
    for array in map(np.ascontiguousarray, arrays):
        found.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    return found.hexdigest()[:16]


def _recorded() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(RECORD.read_text(encoding="utf-8"))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_bits_are_those_that_were_recorded(case: str, tmp_path: Path) -> None:
    recorded, here = _recorded(), environment()
    if others := [name for name, value in here.items() if recorded["environment"][name] != value]:
        pytest.skip(f"digests were recorded in another environment: other {', '.join(others)}")
    scan = CASES[case][0]
    if isinstance(scan, str) and not (SHARED_DATA / scan).is_file():
        pytest.skip(f"{scan} is not beside this checkout (../shared/data)")
    assert digests(case, tmp_path) == recorded["cases"][case]


def _record(wanted: Sequence[str]) -> None:
    """Write the digests of this state and this environment: of all cases, or of those named where it is the same."""
    numba.set_num_threads(1)
    if wanted and _recorded()["environment"] != environment():
        sys.exit(f"{RECORD.name} is of another environment: record all cases here, or leave these to who merges them")
    cases = _recorded()["cases"] if wanted else {}
    for case in wanted or CASES:
        with tempfile.TemporaryDirectory() as folder:
            cases[case] = digests(case, Path(folder))
        print(case, file=sys.stderr)
    text = json.dumps({"environment": environment(), "cases": cases}, indent=1)
    RECORD.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    _record(sys.argv[1:])
