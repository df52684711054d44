"""Documents over 0MQ reach bluesky's own dispatcher; a proxy that is gone or hangs delays nobody."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from beamline.bluesky.documents import published
from beamline.cli.main import main
from beamline.config.load import config_folder
from tests.beamline.ran import SMALL
from tests.free_ports import free_ports

event_model = pytest.importorskip("event_model")
pytest.importorskip("zmq")
CONFIG = str(config_folder() / "simulated.yaml")
WORDS = [word for setting in (*SMALL, "simulation.clock=virtual", "scan.mode=step") for word in ("--set", setting)]


def _free() -> str:
    return f"127.0.0.1:{free_ports(1)[0]}"


@contextmanager
def _listener(address: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "tests.beamline.bluesky.zmq_listener", address, _free()]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        try:
            assert program.stdout is not None and program.stdout.readline() == "ready\n"
            yield program
        finally:
            program.kill()


def _scan(runs: Path, address: str) -> Any:
    return CliRunner().invoke(
        main,
        ["scan", str(config_folder() / "simulated.yaml"), "-o", str(runs), "--documents", f"tcp://{address}", *WORDS],
    )


def test_every_document_of_a_scan_arrives_and_is_valid(tmp_path: Path) -> None:
    with _listener(address := _free()) as program:
        result = _scan(tmp_path, address)
        assert result.exit_code == 0 and "No program is listening" not in result.stderr, result.output
        assert program.stdout is not None
        found: list[tuple[str, dict[str, Any]]] = []
        while not found or found[-1][0] != "stop":
            found.append(json.loads(program.stdout.readline()))
    for name, document in found:
        event_model.schema_validators[event_model.DocumentNames[name]].validate(document)
    names = [name for name, _ in found]
    assert names[:2] == ["start", "descriptor"] and names.count("stream_resource") == 3
    assert found[-1][1]["num_events"] == {"primary": 3 + 2 + 12 + 2}


def test_without_a_listener_the_scan_is_complete_and_says_so(tmp_path: Path) -> None:
    result = _scan(tmp_path, _free())
    assert result.exit_code == 0 and "No program is listening at tcp://127.0.0.1:" in result.stderr
    assert next(tmp_path.glob("*/scan.h5")).is_file()


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize("state", ["hangs", "dies", "was never there"])
def test_a_proxy_that_takes_nothing_costs_microseconds_and_a_second_at_the_end(state: str) -> None:
    document = {"uid": "0" * 36, "text": "x" * 20_000}
    slow = 0  # a busy machine takes the processor away now and then
    with _listener(address := _free()) as program:
        where = _free() if state == "was never there" else address
        with published(f"tcp://{where}", lambda said: None) as emit:
            if state != "was never there":
                os.kill(program.pid, signal.SIGSTOP if state == "hangs" else signal.SIGKILL)
            for _ in range(3000):
                began = time.perf_counter()
                emit("event", document)
                slow += time.perf_counter() - began > 0.1
            ended = time.monotonic()
        assert slow < 10
        assert time.monotonic() - ended < 3
