"""`beamline ride` with APS's simulator (pvapy), as programs: a real scan, a process that stalls, a server that dies."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import psutil
import pytest
from ridden import RideProgram, Stored, stored

from drivers.base.frame import FrameKind

pytestmark = [pytest.mark.timeout(900), pytest.mark.usefixtures("loopback")]
CHANNEL = "P:Pva1:Image"
IMAGE = f"pva://{CHANNEL}"
MINUTE = 600  # frames, at 10 a second
SIMULATOR = """
import sys
from pvapy.cli import adSimServer as simulator
class Started(simulator.AdSimServer):
    def framePublisher(self):
        if not self.nPublishedFrames:
            print("ready", flush=True)
            sys.stdin.readline()
        super().framePublisher()
simulator.AdSimServer = Started
simulator.main()
"""  # its first frame waits for a line of stdin
DISK = """
import sys, time
import beamline.storage.writers.rows as rows
write = rows.Rows.write
def slow(self, frame, *more):
    time.sleep(frame.counts.nbytes / {bytes_per_s})
    return write(self, frame, *more)
rows.Rows.write = slow
from beamline.cli.main import run
run()
"""


@pytest.fixture
def scan(shared_data: Path) -> Path:
    return shared_data / "diamond_24737_parallel_91x135x160.h5"


@contextmanager
def served(source: Path, fps: float) -> Iterator[Callable[[], None]]:
    """The simulator, which sends the frames of a file over and over, from when the function is called."""
    pytest.importorskip("pvapy")
    words = f"-if {source} -hds /exchange/data -fps {fps} -cn {CHANNEL} -std 0 -rt 3600 -rp 100000 -dc -shd 1"
    run = [sys.executable, "-c", SIMULATOR, *words.split()]
    with subprocess.Popen(run, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdin is not None and server.stdout is not None
            while (line := server.stdout.readline()) != "ready\n":
                assert line, "the simulator has ended"
            threading.Thread(target=server.stdout.read, daemon=True).start()
            yield partial(print, file=server.stdin, flush=True)
        finally:
            server.kill()


def _views(n: int) -> dict[str, Any]:
    return {"angles": {"from": "plan", "views": n, "start_deg": 0, "step_deg": 2}}


def _equal_to_the_bit(file: Stored, source: Path, step: float = 2.0) -> None:
    """Each frame once, in order, with the pixels of its number and the angle of its trigger."""
    with h5py.File(source) as scan:
        frames = scan["/exchange/data"][()]
    views = file.of(FrameKind.PROJECTION)
    ids = file.ids[views]
    assert (np.diff(ids) > 0).all()
    assert np.array_equal(file.counts[views], frames[(ids - 1) % len(frames)])
    assert np.allclose(file.degrees[views], step * file.triggers[views])
    assert np.array_equal(file.triggers[views] - file.triggers[views][0], ids - ids[0])


def _on_schedule(file: Stored, fps: float) -> None:
    """The server sent each frame when it was due, by its own clock: no client slowed it."""
    late = file.times - file.times[0] - (file.ids - file.ids[0]) / fps
    assert np.abs(late - np.median(late)).max() < 0.8, late  # s: of the machine itself, at load 10


@pytest.mark.parametrize(
    ("fps", "seconds"), [(10, 10), *(pytest.param(fps, 120, marks=pytest.mark.long) for fps in (10, 50))]
)
@pytest.mark.slow
def test_every_frame_once(tmp_path: Path, scan: Path, fps: int, seconds: int) -> None:
    n = fps * seconds
    given = ("--darks", str(scan), "--flats", str(scan))
    with served(scan, fps) as start, RideProgram(tmp_path, IMAGE, "--no-live", *given, **_views(n)) as ride:
        start()
        assert ride.exit_code() in (0, 7), ride.output  # 7: the monitor sees that the scan comes over and over
    (file,) = stored(tmp_path)
    _equal_to_the_bit(file, scan)
    assert file.ids.tolist() == [-1, -1, *range(1, n + 1)] and file.status == "complete"


@pytest.mark.slow
def test_two_rides_and_a_viewer_of_one_server(tmp_path: Path, scan: Path) -> None:
    n, fps = 200, 20
    viewer = [sys.executable, str(Path(__file__).with_name("viewer.py")), CHANNEL]
    with ExitStack() as stack:
        start = stack.enter_context(served(scan, fps))
        rides = [RideProgram(tmp_path / name, IMAGE, "--no-live", **_views(n)) for name in "ab"]
        for ride in rides:
            stack.enter_context(ride)
        watching = stack.enter_context(subprocess.Popen(viewer, stdin=subprocess.PIPE, stdout=subprocess.PIPE))
        stack.callback(watching.kill)
        assert watching.stdout is not None and watching.stdout.readline() == b"ready\n"
        start()
        seen = [watching.stdout.readline() for _ in range(20)]
        assert all(ride.exit_code() in (0, 7) for ride in rides), [ride.output for ride in rides]
    with h5py.File(scan) as source:
        frames = source["/exchange/data"][()]
    assert all(int(words[1]) == zlib.crc32(frames[int(words[0]) - 1].tobytes()) for words in map(bytes.split, seen))
    for ride in rides:
        (file,) = stored(ride.folder)
        _equal_to_the_bit(file, scan)
        assert file.ids.tolist() == [*range(1, n + 1)] and not file.missing
        _on_schedule(file, fps)


@pytest.mark.slow
@pytest.mark.long
def test_the_page_shows_a_growing_volume_and_the_last_is_that_of_the_file(tmp_path: Path, scan: Path) -> None:
    """At 10 frames/s, with seven views interpolated between each two of the real scan, which would be over in 9 s."""
    source = tmp_path / "finer.h5"
    with h5py.File(scan) as file, h5py.File(source, "w") as finer:
        views, *references = (file[f"/exchange/{name}"][:, ::2, ::2] for name in ("data", "data_dark", "data_white"))
        for name, images in zip(("data_dark", "data_white"), references, strict=True):
            finer[f"/exchange/{name}"] = images
        views = views.astype(float)
        between = [views[:-1] + (views[1:] - views[:-1]) * k / 8 for k in range(8)]
        finer["/exchange/data"] = np.rint(np.stack(between, 1)).reshape(-1, *views.shape[1:]).astype(np.uint16)
        n = len(finer["/exchange/data"])
    angles = {"from": "plan", "views": n, "start_deg": 0, "step_deg": 0.25}
    given = ("--page", "--darks", str(source), "--flats", str(source))
    settings: dict[str, Any] = {"period_s": 0.1, "queue_s": 3, "angles": angles}
    with served(source, 10) as start, RideProgram(tmp_path, IMAGE, *given, **settings) as ride:
        start()
        page = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        address = list[str]()

        def shows_a_volume() -> bool:
            if not address:
                address.extend(re.findall(r"Page to watch the scan: (\S+)", ride.output)[:1])
                if address:
                    page.open(address[0]).close()  # it gives the cookie
                return False
            with suppress(urllib.error.HTTPError), page.open(f"{address[0].partition('?')[0]}api/model.png") as answer:
                return bool(answer.read().startswith(b"\x89PNG"))
            return False

        ride.wait_for(shows_a_volume, 300)
        during = ride.frames()
        assert ride.exit_code(600) in (0, 7), ride.output
    assert during < n, "the picture came after the last frame"
    (run,) = (tmp_path / "runs").glob("*/")
    (file,) = stored(tmp_path)
    _equal_to_the_bit(file, source, 0.25)
    assert file.ids.tolist() == [-1, -1, *range(1, n + 1)]
    command = [sys.executable, "-m", "beamline.cli.main", "recon", str(run / "scan.h5"), "-o", str(tmp_path / "r.h5")]
    subprocess.run([*command, "-m", "r2", "--seed", "0"], check=True, capture_output=True)
    volumes = []
    for path in (run / "recon.h5", tmp_path / "r.h5"):
        with h5py.File(path) as volume:
            volumes.append(np.asarray(next(volume[name] for name in ("/entry/data/data", "/volume") if name in volume)))
    live_volume, finished = volumes
    assert live_volume.shape == finished.shape
    assert np.corrcoef(live_volume.ravel(), finished.ravel())[0, 1] > 0.98


@pytest.mark.skipif(sys.platform == "win32", reason="no process is stopped there by a signal")
@pytest.mark.parametrize(("still", "whole"), [(1, True), (5, True), (5, False)])
@pytest.mark.slow
def test_a_ride_that_stands_still(tmp_path: Path, scan: Path, still: int, whole: bool) -> None:
    """Where its receiver stands still, too, the server bridges a second, and of five what is lost is named.
    The ride alone loses nothing. Nothing comes twice."""
    n = 450
    queue: dict[str, Any] = {"period_s": 0.02, "queue_s": 2}  # other programs run here, too
    with served(scan, 50) as start, RideProgram(tmp_path, IMAGE, "--no-live", **queue, **_views(n)) as ride:
        start()
        ride.wait_for(lambda: ride.frames() > 50)
        process = psutil.Process(ride.process.pid)
        stopped = [process, *([each for each in process.children() if "receiver" in str(each.cmdline())] * whole)]
        assert len(stopped) == 1 + whole
        for each in stopped:
            each.suspend()
        time.sleep(still)
        for each in stopped:
            each.resume()
        code = ride.exit_code()
    (file,) = stored(tmp_path)
    _equal_to_the_bit(file, scan)
    _on_schedule(file, 50)
    missing = sorted({*range(n)} - {*(file.ids - 1).tolist()})
    assert file.missing == missing and ((still > 1 and whole) or not missing) and len(missing) < 50 * still
    if missing:
        assert code == 5 and "were lost by this program, which stalled for" in ride.output, ride.output


@pytest.mark.slow
def test_a_server_that_is_killed_and_comes_back(tmp_path: Path, scan: Path) -> None:
    n = 120
    with ExitStack() as stack:
        with served(scan, 20) as start:
            ride = stack.enter_context(RideProgram(tmp_path, IMAGE, "--no-live", **_views(n)))
            start()
            ride.wait_for(lambda: ride.frames() > 20)
        ride.wait_for(lambda: "connection to the server of" in ride.output)
        with served(scan, 20) as start:
            start()
            assert ride.exit_code() == 5
    assert "numbers restarted at" in ride.output
    first, second = stored(tmp_path)
    assert first.status == "failed" and second.status == "complete" and second.ids[0] < 60  # found again soon
    assert np.array_equal(second.ids, second.ids[0] + np.arange(n))
    for file in (first, second):
        _equal_to_the_bit(file, scan)


@pytest.mark.parametrize("ring", [2048.0, 5.0])
@pytest.mark.slow
def test_a_disk_of_5_mb_s(tmp_path: Path, scan: Path, ring: float) -> None:
    """Frames of 173 kB at 80 a second: 13.8 MB/s. A ring that is large enough loses none. A small one, and the 128
    frames of the recorder, are full after about 3 s."""
    n, fps, source = 500, 80, tmp_path / "large.h5"
    with h5py.File(scan) as file, h5py.File(source, "w") as large:
        large["/exchange/data"] = file["/exchange/data"][:].repeat(2, 1).repeat(2, 2)
    options: dict[str, Any] = {"program": DISK.format(bytes_per_s=5e6), "ring_mb": ring, "period_s": 1 / fps}
    with served(source, fps) as start, RideProgram(tmp_path, IMAGE, "--no-live", **options, **_views(n)) as ride:
        start()
        code = ride.exit_code()
    (file,) = stored(tmp_path)
    _equal_to_the_bit(file, source)
    _on_schedule(file, fps)
    assert file.missing == sorted({*range(n)} - {*(file.ids - 1).tolist()})
    if ring > 1000:
        assert code in (0, 7) and not file.missing, ride.output
    else:
        assert code == 5 and file.missing, ride.output
        assert "memory for waiting frames was full, because the disk is too slow" in ride.output


@pytest.mark.slow
def test_a_ride_that_is_killed_is_recovered(tmp_path: Path, scan: Path) -> None:
    with served(scan, 20) as start, RideProgram(tmp_path, IMAGE, "--no-live", **_views(600)) as ride:
        start()
        ride.wait_for(lambda: ride.frames() > 30)
        committed = ride.frames()
        ride.process.kill()
        ride.exit_code()
    (run,) = (tmp_path / "runs").glob("*/")
    time.sleep(10)  # for so long a file counts as being written
    command = [sys.executable, "-m", "beamline.cli.main", "recover", str(run)]
    recovered_by = subprocess.run(command, capture_output=True, text=True)
    assert recovered_by.returncode == 0, recovered_by.stderr
    (file,) = stored(tmp_path)
    _equal_to_the_bit(file, scan)
    assert file.ids.tolist() == [*range(1, len(file.ids) + 1)] and len(file.ids) >= committed
    with h5py.File(run / "scan.h5") as recovered:
        assert recovered["/exchange/data"].shape == file.counts.shape


@pytest.mark.bench
def test_large_frames_for_a_minute(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    """2048 x 2048 x 16 bit at 10 a second, 84 MB/s: none lost, each equal to the bit. CPU and memory are recorded.

    It needs two free cores and a disk that keeps up.
    """
    n = MINUTE
    noise = np.random.default_rng(0).integers(0, 2**16, (13, 2048, 2048), dtype=np.uint16)  # another one each time
    with h5py.File(tmp_path / "large.h5", "w") as file:
        file["/exchange/data"] = noise
    with (
        served(tmp_path / "large.h5", 10) as start,
        RideProgram(tmp_path, IMAGE, "--no-live", period_s=0.1, **_views(n)) as ride,
    ):
        start()
        process, most, cpu = psutil.Process(ride.process.pid), 0.0, 0.0
        while ride.process.poll() is None:
            try:
                family = [process, *process.children()]
                most = max(most, sum(each.memory_info().rss for each in family) / 1e9)
                cpu = max(cpu, sum(sum(each.cpu_times()[:2]) for each in family))
            except psutil.Error:
                break
            time.sleep(0.5)
        code = ride.exit_code()
    record_property("cpu_s", cpu)
    record_property("memory_gb", most)
    print(f"{n} frames of 8.4 MB: {cpu:.1f} s of CPU, {most:.2f} GB at most")
    (path,) = (tmp_path / "runs").glob("*/scan.h5")
    with h5py.File(path) as file:
        ids, counts = file["/entry/frame_log/framestamp"][()], file["/entry/instrument/detector/data"]
        assert all(np.array_equal(counts[row], noise[(i - 1) % len(noise)]) for row, i in enumerate(ids))
    assert ids.tolist() == [*range(1, n + 1)] and code in (0, 7), ride.output
