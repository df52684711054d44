"""Runs in the browser: their table, and the page of each below a number of the server's own."""

import json
from pathlib import Path

import pytest

from beamline.page import runs
from tests.beamline.page.served import Served, listed
from tests.beamline.page.test_app import tile
from tests.beamline.scans import TwoCylinders, frames_of, write_flagged

SCAN = TwoCylinders()
EVIL = "<img src=x>"


def made(folder: Path, day: int, sample: str) -> Path:
    """A run of a day, which was stopped before it had all its frames."""
    run = folder / f"202601{day:02d}T120000Z_s"
    run.mkdir()
    events = (
        {"event": "run_started", "time": 1.0, "sample": sample, "n_frames": 60},
        {"event": "state", "time": 2.0, "state": "stopped"},
    )
    (run / "events.jsonl").write_text("".join(f"{json.dumps(event)}\n" for event in events))
    write_flagged(run / "scan.h5", frames_of(SCAN), {})
    return run


def rows(page: Served) -> list[dict[str, object]]:
    return list(json.loads(page.ask("/api/runs")[2])["rows"])


def test_the_table_is_that_of_the_terminal_newest_first(tmp_path: Path) -> None:
    made(tmp_path, 1, "first")
    with listed(tmp_path) as page:
        (before,) = rows(page)
        made(tmp_path, 2, EVIL)
        newer, older = rows(page)
    assert older == before  # its number stays, so that a link does
    assert before["cells"][1:4] == ["first", "49 of 60", "stopped"]
    assert newer["cells"][1] == EVIL
    assert newer["number"] != older["number"]


def test_each_run_has_its_page(tmp_path: Path) -> None:
    folders = [made(tmp_path, day, f"sample {day}") for day in (1, 2, 3)]
    with listed(tmp_path) as page:
        for row, run in zip(rows(page), reversed(folders), strict=True):
            root = f"/run/{row['number']}"
            assert b"main.js" in page.ask(f"{root}/")[2]
            assert json.loads(page.ask(f"{root}/api/facts")[2])["run"] == run.name
            assert tile(page.ask(f"{root}/api/frame/10?corrected=0")[2])[1].shape == SCAN.shape


def test_runs_beyond_those_that_stay_open_are_opened_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "_OPEN", 1)
    for day in (1, 2):
        made(tmp_path, day, "s")
    with listed(tmp_path) as page:
        for _ in range(2):
            for row in rows(page):
                assert page.ask(f"/run/{row['number']}/api/facts")[0] == 200


def test_a_page_of_a_run_has_the_same_rules(tmp_path: Path) -> None:
    made(tmp_path, 1, "s")
    with listed(tmp_path) as page:
        (row,) = rows(page)
        root = f"/run/{row['number']}"
        for path in ("/", "/api/runs", f"{root}/", f"{root}/api/frame/0", f"{root}/api/feed"):
            assert page.ask(path, token="")[0] == 403
            assert page.ask(path, headers={"Host": "evil.example"})[0] == 421
        headers = page.ask(f"{root}/api/facts")[1]
        assert headers["content-security-policy"].startswith("default-src 'self'")
        assert page.ask(f"{root}/api/verb/stop", "POST", headers={"Origin": f"http://{page.host}"})[0] == 403
        for path in ("/run/7/api/facts", "/run/../api/facts/", "/run/x/", f"/run/%2e%2e/{tmp_path.name}/"):
            assert page.ask(path)[0] == 404


def test_a_folder_without_runs_has_an_empty_table(tmp_path: Path) -> None:
    with listed(tmp_path) as page:
        assert rows(page) == []
