"""Wrong commands of new users: the sentence names what the file or the word is, and what to type instead."""

from pathlib import Path

import numpy as np
import pytest

from tests.beamline.cli.small_scan import beamline, left, succeeds

pytestmark = pytest.mark.usefixtures("one_thread")

CASES = {
    "a scan for a configuration": (["scan", "scan.h5", "--dry-run"], 2, ["not a configuration", "beamline info"]),
    "a scan to watch": (["watch", "scan.h5"], 5, ["not written by `beamline scan`", "beamline view scan.h5"]),
    "a scan beside a volume": (["view", "scan.h5", "volume.npz"], 2, ["is a scan, which is shown alone"]),
    "a scan to export": (["export", "scan.h5", "-o", "s.tif"], 5, ["is a scan", "beamline recon scan.h5"]),
    "a volume of Python": (["recon", "volume.npz"], 5, ["no angle", "--angles FILE"]),
    "NIfTI": (["export", "volume.npz", "-o", "v.nii.gz"], 2, ["NIfTI is read, not written", ".nrrd"]),
    "half pixels": (["recon", "scan.h5", "--bin", "3.5"], 2, ["'3.5' is not a valid integer"]),
    "a sweep of one value": (["sweep", "scan.h5", "tv-weight=0.1"], 2, ["two values", "recon --tv-weight 0.1"]),
    "the centre": (["sweep", "scan.h5", "center=18:22:1"], 2, ["did you mean axis?"]),
    "a file for a template": (["config", "init", "my.yaml"], 2, ["config init > my.yaml"]),
    "a missing colon": (["check", "bad.yaml"], 2, ["bad.yaml:4", "colon is missing"]),
    "an axis outside": (["recon", "scan.h5", "--axis", "900"], 2, ["column 900", "0 to 39"]),
    "no such run": (["stop", "nosuch"], 2, ["no folder nosuch", "runs"]),
    "no such file": (["watch", "nosuch.h5"], 2, ["no file or folder nosuch.h5", "no runs in runs"]),
}


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("camera:\n  driver simulated\n  exposure_s: 0.1\n", 3, "a colon is missing"),
        ("# mine\ncamera\n  driver: simulated\n", 3, "a colon is missing"),
        ("# mine\nperiod_s: 1: 2\n", 2, "a colon is missing"),
        ("views: 3\n  period_s: 1\n", 2, "this line is indented deeper than the one above, which already has a value"),
    ],
)
def test_the_line_without_a_colon_is_named(folder: Path, text: str, line: int, what: str) -> None:
    (folder / "bad.yaml").write_text(text)
    result = beamline("check", "bad.yaml")
    assert f"bad.yaml:{line}: this is not YAML ({what}" in " ".join(result.stderr.split())


@pytest.mark.parametrize("case", CASES)
def test_the_sentence_names_what_it_is_and_what_to_type(case: str, folder: Path) -> None:
    arguments, code, expected = CASES[case]
    np.savez(folder / "volume.npz", data=np.zeros((4, 5, 6), np.float32))
    (folder / "bad.yaml").write_text("camera:\n  driver: simulated\n  exposure_s 0.1\nscan:\n  views: 3\n")
    before = left(folder)
    result = beamline(*arguments)
    assert result.exit_code == code, result.output
    assert not [words for words in expected if words not in " ".join(result.stderr.split())], result.stderr
    assert left(folder) == before


def test_a_volume_to_reconstruct_is_named_with_its_method(folder: Path) -> None:
    succeeds("recon", "scan.h5", "-m", "fbp", "-o", "volume.h5", "--no-report")
    result = beamline("recon", "volume.h5")
    assert result.exit_code == 5
    assert "is a volume, made by fbp" in " ".join(result.stderr.split()) and "beamline view" in result.stderr
