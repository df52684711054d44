"""Labels of anomalies: runs of frames, kept in JSON and read back."""

import json
from pathlib import Path

import pytest

from beamline.core.errors import DataError
from beamline.simulate import LabelledRun, LabelLog, labels_path, write_labels
from simulators.effects.chain import AnomalyLabel
from tests.beamline.simulate.read_labels import read_labels

A, B, C = (0, 4, 0, 4), (1, 5, 1, 5), (2, 6, 2, 6)


def test_consecutive_frames_of_a_kind_are_one_run() -> None:
    log = LabelLog()
    for frame, labels in enumerate(
        [
            [],
            [AnomalyLabel("ghost", A)],
            [AnomalyLabel("jump", C), AnomalyLabel("ghost", B)],
            [],
            [AnomalyLabel("ghost", C)],
        ]
    ):
        log.add(frame, labels)
    runs = log.runs()
    assert runs == (LabelledRun("ghost", 1, (A, B)), LabelledRun("jump", 2, (C,)), LabelledRun("ghost", 4, (C,)))
    assert [run.last for run in runs] == [2, 2, 4]


def test_each_of_several_of_a_kind_has_a_run_of_its_own() -> None:
    log = LabelLog()
    log.add(0, [AnomalyLabel("floaters", A)])
    log.add(1, [AnomalyLabel("floaters", B), AnomalyLabel("floaters", C, 1)])
    log.add(2, [AnomalyLabel("floaters", A, 1)])
    assert log.runs() == (LabelledRun("floaters", 0, (A, B)), LabelledRun("floaters", 1, (C, A)))


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    path = labels_path(tmp_path / "scan.h5")
    assert path.name == "scan.labels.json"
    runs = (LabelledRun("ghost", 1, (A, B)),)
    write_labels(path, runs, n_frames=9)
    assert read_labels(path) == runs
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content["frames"] == 9
    assert content["anomalies"][0] == {
        "kind": "ghost",
        "first_frame": 1,
        "last_frame": 2,
        "regions": [list(A), list(B)],
    }
    with pytest.raises(DataError, match="are never overwritten"):
        write_labels(path, (), n_frames=1)


def test_a_scan_without_anomalies_says_so(tmp_path: Path) -> None:
    write_labels(tmp_path / "x.json", (), n_frames=3)
    assert read_labels(tmp_path / "x.json") == ()
