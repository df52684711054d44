"""Slabs that are stopped and resumed: the same volume bit for bit, and no finished work is lost."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np
import pytest

import recon
from beamline.reconstruct import estimate
from beamline.reconstruct.slab_run import _as_they_come
from beamline.storage.recon_record import ReconRecord
from beamline.storage.writers.partial_volume import PartialVolume, open_partial
from beamline.storage.writers.recon_file import read_reconstruction
from recon.forecast import Forecast
from recon.voxels.methods import FistaTv
from tests.beamline.cli.small_scan import beamline, left
from tests.beamline.scans import TwoCylinders, write_exchange

FISTA = (
    "recon", "scan.h5", "-m", "fista-tv", "--iterations", "2", "--tv-weight", "0.002", "--no-report",
    "--memory", "4.4M",
)  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A noisy scan of 96 rows, scan.h5, and its volume, whole.h5, of three slabs."""
    folder = tmp_path_factory.mktemp("made")
    scan = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(96, 32), axis_col=15.7)
    counts = 100 + np.random.default_rng(20261120).poisson(scan.counts().astype(float) - 100)
    write_exchange(folder / "scan.h5", scan, {"data": counts.astype(np.uint16)})
    with contextlib.chdir(folder):
        assert beamline(*FISTA, "-o", "whole.h5").exit_code == 0
    assert left(folder) == {"scan.h5", "whole.h5"}
    return folder


def parts_and_whole(made: Path) -> tuple[ReconRecord, ReconRecord]:
    """Of a run that was resumed and one that was not, with the same voxels."""
    parts, whole = read_reconstruction(Path("parts.h5")), read_reconstruction(made / "whole.h5")
    np.testing.assert_array_equal(parts.volume.data, whole.volume.data)
    return parts, whole


def interrupt_after(monkeypatch: pytest.MonkeyPatch, slabs: int, *, half: bool = False) -> None:
    """Ctrl-C when so many slabs were added; `half`: in the middle of adding the next one."""
    add, added = PartialVolume.add, list[Any]()

    def adding(self: PartialVolume, n: int, data: np.ndarray | None, **more: Any) -> None:
        if len(added) == slabs and not half:
            raise KeyboardInterrupt
        if len(added) == slabs:
            assert data is not None
            add(self, n, data, **more)
            self._maps["state"][n] = 1
            raise KeyboardInterrupt
        added.append(n)
        add(self, n, data, **more)

    monkeypatch.setattr(PartialVolume, "add", adding)


@pytest.mark.slow
def test_resumed_is_uninterrupted_to_the_bit(made: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped within the second slab, resumed, stopped after another one, resumed."""
    resume = ("-o", "parts.h5", "--resume", "parts.partial.h5")
    for slabs, half, more in ((1, True, resume[:2]), (1, False, resume)):
        with monkeypatch.context() as patch:
            interrupt_after(patch, slabs, half=half)
            stopped = beamline(*FISTA, *more)
        assert stopped.exit_code == 4 and "--resume parts.partial.h5" in stopped.stderr, stopped.output
        assert left(folder) == {"scan.h5", "parts.partial.h5"}
    said, found = beamline("info", "parts.partial.h5"), beamline("validate", "parts.partial.h5")
    assert said.exit_code == 0 and "64 of 96 slices" in said.stdout
    assert found.exit_code == 5 and "64 of 96 slices are reconstructed" in found.output

    resumed = beamline(*FISTA, *resume)
    assert resumed.exit_code == 0 and "64 of 96 slices are done." in resumed.stderr, resumed.output
    parts, whole = parts_and_whole(made)
    assert parts.metrics["residual"] == whole.metrics["residual"] > 0
    assert parts.parameters["resumed_from"] == "parts.partial.h5"
    assert left(folder) == {"scan.h5", "parts.h5"}


def test_a_volume_of_slabs_is_as_any_other(made: Path) -> None:
    assert beamline("validate", str(made / "whole.h5")).exit_code == 0
    found = read_reconstruction(made / "whole.h5")
    assert found.parameters["slabs"] == 3 and "partial" not in found.parameters
    assert (made / "whole.h5").stat().st_size < found.volume.data.nbytes * 1.2  # not with slices that slabs shared


def test_a_slab_that_its_method_makes_with_another_one_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As by from-reference, if the reference shows no material in a slab. The record has the method of the first."""
    run, done = FistaTv.run, list[int]()

    def with_another(self: FistaTv, *given: Any) -> recon.Reconstruction:
        done.append(len(done))
        result = run(self, *given)
        return result if done[-1] != 1 else replace(result, method="sirt", chosen="there is nothing to begin from")

    monkeypatch.setattr(FistaTv, "run", with_another)
    made = beamline(*FISTA, "-o", "out.h5")
    record, sentence = (
        read_reconstruction(Path("out.h5")),
        "were reconstructed with sirt, not with the method of the first slab: there is nothing to",
    )
    assert made.exit_code == 0 and made.stderr.count(sentence) == 1, made.output
    others = np.array(record.parameters["slices_by_another_method"])
    assert record.method == "fista-tv" and f"Slices {others[0]} to {others[-1]} were reconstructed with" in made.stderr
    assert others.size == 32 and (np.diff(others) == 1).all()


@pytest.mark.slow
def test_other_data_or_options_are_refused_and_nothing_is_touched(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        interrupt_after(patch, 1)
        beamline(*FISTA, "-o", "out.h5")
    before = Path("out.partial.h5").read_bytes()
    for options, said in {
        ("--seed", "3"): "seed (3, 0 in the file)",
        ("--tv-weight", "0.01"): "tv_weight (0.01, 0.002 in the file)",
        ("--air", "none"): "projections (other content)",
        ("--rows", "0:80"): "contains a volume of 96 slices, but this reconstruction has 80",
        ("--memory", "3.5M"): "Use --memory 5M if",
    }.items():
        refused = beamline(*FISTA, "-o", "out.h5", "--resume", "out.partial.h5", *options)
        assert refused.exit_code == 5 and said in refused.stderr, refused.output
    again = beamline(*FISTA, "-o", "out.h5")
    assert again.exit_code == 5 and "--resume" in again.stderr
    busy = open_partial(Path("out.partial.h5"))
    assert "is open in another process" in beamline(*FISTA, "-o", "out.h5", "--resume", "out.partial.h5").stderr
    del busy
    assert Path("out.partial.h5").read_bytes() == before and left(folder) == {"scan.h5", "out.partial.h5"}


@pytest.mark.slow
def test_a_dry_run_says_what_is_left(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of three slabs: that much of the time, and no disk for the slabs that are there. The file stays as it is."""
    with monkeypatch.context() as patch:
        interrupt_after(patch, 1)
        beamline(*FISTA, "-o", "out.h5")
    before = Path("out.partial.h5").read_bytes()
    monkeypatch.setattr(estimate, "forecast", lambda *_: Forecast(1000.0, {"a": 96.0, "b": 48.0}))  # a second a slice
    all_of_it, rest = (
        json.loads(beamline(*FISTA, *more, "--dry-run", "--json").stdout.splitlines()[-1])
        for more in (("-o", "other.h5"), ("-o", "out.h5", "--resume", "out.partial.h5"))
    )
    assert (rest["seconds"], rest["least_seconds"]) == (100, 50)
    assert (all_of_it["slabs"], all_of_it["done"], rest["slabs"], rest["done"]) == (3, 0, 2, 32)
    assert (all_of_it["seconds"], all_of_it["least_seconds"]) == (1144, 1072)  # what the data choose, is chosen once
    assert all_of_it["scratch"] - rest["scratch"] == rest["output"] and rest["memory"] == all_of_it["memory"]
    said = beamline(*FISTA, "--resume", "out.partial.h5", "--dry-run").stdout
    assert "2 slabs remaining; 32 of 96" in said
    assert "about 1.67 min; about 50 s if the method ends early with these data; reading" in said
    other = beamline(*FISTA, "--rows", "0:80", "--resume", "out.partial.h5", "--dry-run")
    assert other.exit_code == 5 and "contains a volume of 96 slices, but this reconstruction has 80" in other.stderr
    assert Path("out.partial.h5").read_bytes() == before and left(folder) == {"scan.h5", "out.partial.h5"}


@pytest.mark.slow
def test_a_partial_volume_in_the_way_of_a_run_without_slabs_stays(folder: Path) -> None:
    Path("out.partial.h5").write_text("of somebody else")
    result = beamline("recon", "scan.h5", "-m", "fbp", "--no-report", "--memory", "1G", "-o", "out.h5")
    assert result.exit_code == 0 and Path("out.partial.h5").read_text() == "of somebody else"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_killed_run_is_resumed_to_the_bit(folder: Path) -> None:
    """By SIGKILL, which nothing in the program sees."""
    sirt = ("recon", "scan.h5", "-m", "sirt", "--iterations", "60", "--no-report", "--memory", "1M")
    process = subprocess.Popen(
        [sys.executable, "-m", "beamline.cli.main", *sirt, "-o", "parts.h5"], cwd=folder, stderr=subprocess.DEVNULL
    )
    partial, deadline = folder / "parts.partial.h5", time.monotonic() + 120
    while process.poll() is None and not partial.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert beamline(*sirt, "-o", "parts.h5", "--resume", "parts.partial.h5").exit_code == 0
    assert beamline(*sirt, "-o", "whole.h5").exit_code == 0
    whole, parts = (read_reconstruction(Path(name)).volume.data for name in ("whole.h5", "parts.h5"))
    np.testing.assert_array_equal(parts, whole)


def test_no_more_slabs_wait_to_be_written_than_are_made_at_a_time() -> None:
    """Each is let go of when it was taken; an error of one is raised in its place."""
    alive: WeakSet[Made] = WeakSet()
    most = 0

    def make(n: int) -> Made:
        nonlocal most
        alive.add(made := Made(n))
        most = max(most, len(alive))
        return made

    taken = []
    for n, made in _as_they_come(make, range(20), 3):
        assert made.n == n
        taken.append(n)
        time.sleep(0.002)  # the disk is slower than the workers
    assert sorted(taken) == list(range(20)) and most <= 3 + 1  # and the one that was just taken
    with pytest.raises(ZeroDivisionError):
        list(_as_they_come(lambda n: 1 / n, [1, 0], 1))


@dataclass(eq=False)
class Made:
    """A slab."""

    n: int
