"""Programs of others read a published scan: bluesky over both protocols, p4p, a viewer, and a client that stalls."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import h5py
import numpy as np
import pytest

from drivers.base.frame import FrameKind
from splatline_areadetector.publish_frames import PublishedFrame
from splatline_areadetector.publish_servers import ImageServer

HERE = Path(__file__).parent
CLIENTS = ("ophyd_async", "pvaccess")  # not imported here: pvapy and p4p bring different libraries of EPICS
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(not all(map(find_spec, CLIENTS)), reason=f"needs {', '.join(CLIENTS)}"),
]
WITHIN = 120.0  # s
VIEWS = 2000  # more than the scan takes before it is stopped


@contextmanager
def _program(*command: object, log: Path) -> Iterator[subprocess.Popen[str]]:
    """A program that is ended at the end; its stderr is in `log`."""
    with (
        log.open("w", encoding="utf-8") as errors,
        subprocess.Popen(
            [sys.executable, *map(str, command)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        ) as process,
    ):
        try:
            yield process
        finally:
            process.kill()


def _until(met: Callable[[], Any], within: float = WITHIN) -> None:
    deadline = time.monotonic() + within
    while not met():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _line(process: subprocess.Popen[str], begin: str = "") -> str:
    """The next line of a program's stdout that begins so."""
    assert process.stdout is not None
    while (line := process.stdout.readline()) and not line.startswith(begin):
        pass
    assert line, "the program has ended"
    return line


def _read(process: subprocess.Popen[str], lines: list[list[str]]) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        lines.append(line.split())


class Ridden:
    """What clients saw of one scan, and its file."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.runs, self.files = folder / "runs", folder / "files"
        self.runs.mkdir()
        self.files.mkdir()
        self.judged: dict[str, dict[str, Any]] = {}
        self.by_p4p: list[tuple[int, int]] = []
        self.by_viewer: list[list[str]] = []
        self.dropped = 0
        self.exit_code = self.published = -1

    @property
    def scan(self) -> Path:
        (run,) = self.runs.iterdir()
        return run / "scan.h5"


@pytest.fixture(scope="module")
def ridden(loopback: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Ridden:
    """One scan, published, with all clients at once; it is stopped when they are done."""
    from p4p.client.thread import Context

    ridden = Ridden(tmp_path_factory.mktemp("ridden"))
    log, beamline = ridden.folder, ("-m", "beamline.cli.main")
    publish = (*beamline, "publish", ridden.runs, "--prefix", "T:DET:", "--files", ridden.files)
    scan = (
        *beamline, "scan", "configs/simulated.yaml", "--no-live", "-o", ridden.runs,
        "--set", "scan.mode=step", "--set", f"scan.angles.views={VIEWS}",  # a fly scan would overrun a busy computer
    )  # fmt: skip
    with ExitStack() as stack:
        server = stack.enter_context(_program(*publish, log=log / "publish.log"))
        _line(server, "Publishing the image T:DET:Pva1:Image at 127.0.0.1")
        viewers = [stack.enter_context(_program(HERE / "viewer.py", "T:DET:Pva1:Image", log=log / f"viewer{i}.log"))
                   for i in range(2)]  # fmt: skip
        client = stack.enter_context(Context("pva", nt=False))

        def see(value: Any) -> None:
            if value.value is not None:
                ridden.by_p4p.append((value.uniqueId, zlib.crc32(value.value.tobytes())))

        stack.enter_context(closing(client.monitor("T:DET:Pva1:Image", see, request="record[queueSize=100]")))
        for viewer in viewers:
            _line(viewer, "ready")
        threading.Thread(target=_read, args=(viewers[0], ridden.by_viewer), daemon=True).start()
        running = stack.enter_context(_program(*scan, log=log / "scan.log"))
        _until(lambda: len(ridden.by_p4p) > 30)  # the darks, the flats, and projections
        viewers[1].send_signal(signal.SIGSTOP)  # it stands still to the end
        for scheme in ("ca", "pva"):
            judge = (HERE / "bluesky_judge.py", f"{scheme}://T:DET:", ridden.files, 5)
            with _program(*judge, log=log / f"{scheme}.log") as process:
                ridden.judged[scheme] = json.loads(_line(process, "{"))
        running.send_signal(signal.SIGINT)
        ridden.exit_code = running.wait(WITHIN)
        with h5py.File(ridden.scan) as file:
            n = int(file["entry/progress/frames_committed"][()])
        _until(lambda: ridden.by_p4p[-1][0] == n, 30.0)
        _until(lambda: ridden.by_viewer and int(ridden.by_viewer[-1][0]) == n, 30.0)
        ridden.dropped = int(client.get("T:DET:Pva1:DroppedArrays_RBV", request="field(value)").value)
        server.send_signal(signal.SIGINT)
        ridden.published = server.wait(WITHIN)
        viewers[1].send_signal(signal.SIGCONT)
    return ridden


def test_a_client_that_stands_still_does_not_touch_the_scan(ridden: Ridden) -> None:
    """The scan was stopped by its operator (exit code 4), with a frame for each trigger until then."""
    assert (ridden.exit_code, ridden.published) == (4, 0)
    with h5py.File(ridden.scan) as file:
        views = file["entry/frame_log/kind"][:] == FrameKind.PROJECTION
        triggers = file["entry/frame_log/trigger"][:][views]
        assert len(triggers) > 9 and triggers.tolist() == list(range(len(triggers)))


@pytest.mark.parametrize("scheme", ["ca", "pva"])
def test_blueskys_client_gets_its_frames(ridden: Ridden, scheme: str) -> None:
    """Its file has rows of the scan file, one after the other, to the bit, with their angles and kinds."""
    documents = ridden.judged[scheme]
    assert (documents["shape"], documents["dtype"]) == ([1, 144, 160], "<u2")
    assert documents["keys"] == ["AcquireTime", "Angle", "HDF5FrameLocation", "Kind", "det"]
    assert documents["indices"] == [{"start": 0, "stop": 5}] * 5
    with h5py.File(urlparse(documents["uri"]).path) as copied, h5py.File(ridden.scan) as scan:
        attributes = copied["entry/instrument/NDAttributes"]
        rows = attributes["NDArrayUniqueId"][:] - 1
        assert np.diff(rows).tolist() == [1] * 4
        np.testing.assert_array_equal(copied["entry/data/data"][:], scan["entry/data/data"][rows])
        np.testing.assert_array_equal(attributes["Angle"][:], scan["entry/sample/rotation_angle"][rows])
        kinds = [FrameKind(int(kind)).name.lower() for kind in scan["entry/frame_log/kind"][rows]]
        assert [kind.decode() for kind in attributes["Kind"][:]] == kinds


def _checksums(scan: Path) -> dict[int, int]:
    """CRC-32 of the pixels by the frame's number."""
    with h5py.File(scan) as file:
        return {i + 1: zlib.crc32(frame.tobytes()) for i, frame in enumerate(file["entry/data/data"])}


def test_p4p_gets_each_frame_once_in_order_and_to_the_bit(ridden: Ridden) -> None:
    checksums = _checksums(ridden.scan)
    assert [number for number, _ in ridden.by_p4p] == list(checksums)
    assert dict(ridden.by_p4p) == checksums


def test_a_viewer_by_pvapy_sees_the_same_frames(ridden: Ridden) -> None:
    """With the default queue of its library, on a machine with other work: it may miss some, and shows no wrong one."""
    checksums, numbers = _checksums(ridden.scan), [int(line[0]) for line in ridden.by_viewer]
    assert numbers == sorted(set(numbers)) and len(numbers) > 0.9 * len(checksums)
    assert all(int(line[1]) == checksums[int(line[0])] for line in ridden.by_viewer)
    assert {tuple(line[2:4]) for line in ridden.by_viewer} == {("160", "144")}
    with h5py.File(ridden.scan) as scan:
        kinds = scan["entry/frame_log/kind"][:]
    assert [line[4] for line in ridden.by_viewer] == [FrameKind(int(kinds[n - 1])).name.lower() for n in numbers]


def test_a_client_that_stands_still_loses_its_own_frames_and_holds_nobody_up(
    loopback: dict[str, str], tmp_path: Path
) -> None:
    """Posting 8 MB never waits for it; another client gets each frame, and what it misses is counted."""
    from p4p.client.thread import Context

    n, frame, come, slowest = 60, np.zeros((2048, 2048), np.uint16), list[int](), 0.0
    with closing(ImageServer("T:Pva1:Image", "127.0.0.1", 0)) as image, Context("pva", nt=False) as client:
        watched = client.monitor("T:Pva1:Image", lambda value: come.append(value.uniqueId), "record[queueSize=100]")
        still_one = _program(HERE / "viewer.py", "T:Pva1:Image", log=tmp_path / "viewer.log")
        with closing(watched), still_one as still:
            _line(still, "ready")
            _until(lambda: len(image_clients(image)) == 2)
            still.send_signal(signal.SIGSTOP)
            for i in range(1, n + 1):
                begin = time.perf_counter()
                image.post(PublishedFrame(frame + np.uint16(i), i, FrameKind.PROJECTION, 0.0, time.time(), 0.01))
                slowest = max(slowest, time.perf_counter() - begin)
                image.clients()
                time.sleep(0.05)
            _until(lambda: come and come[-1] == n)
            missed = sorted(each.missed for each in image.clients().values())
            still.send_signal(signal.SIGCONT)
    assert [number for number in come if number] == list(range(1, n + 1))
    assert missed[0] == 0 and missed[1] > n // 2
    assert slowest < 1.0


def image_clients(image: ImageServer) -> list[str]:
    """Clients by the server's own report, before any frame."""
    return [line for line in image._server.tostr(5).splitlines() if "MONITOR" in line]
