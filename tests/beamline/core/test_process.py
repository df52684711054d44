"""A child process: its lines arrive in order, and it has ended when it should have, whatever happens to it."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from beamline.core.errors import exit_code, user_message
from beamline.core.process import ChildProcess, NoPythonError, ProcessEnd, python
from tests.clock import wait_until

posix = pytest.mark.skipif(sys.platform == "win32", reason="Windows ends a process without asking it")

SLEEPS = "import time; print('begun', flush=True); time.sleep(100)"
DELIVERS = """
import signal, sys, time
def deliver(*_):
    print("delivered", flush=True)
    sys.exit(4)
signal.signal(signal.SIGTERM, deliver)
print("begun", flush=True)
time.sleep(100)
"""
IGNORES = """
import signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("begun", flush=True)
time.sleep(100)
"""
CHATTERS = """
import time
for n in range(6):
    print(n, flush=True)
    time.sleep(0.1)
"""


class _Child:
    def __init__(self, folder: Path, code: str, **options: Any) -> None:
        self.lines: list[str] = []
        self.log = folder / "stderr.txt"
        with self.log.open("w", encoding="utf-8") as stderr:
            self.process = ChildProcess([sys.executable, "-c", code], stderr, self._take, **options)

    def _take(self, line: str) -> None:
        self.lines.append(line.rstrip())

    def begun(self) -> bool:
        return bool(self.lines)


def test_lines_code_and_stderr_arrive(tmp_path: Path) -> None:
    child = _Child(tmp_path, "import sys; print(1); print(2); sys.exit('no room')")
    assert child.process.wait() is ProcessEnd.EXITED
    assert (child.lines, child.process.code, child.process.running) == (["1", "2"], 1, False)
    assert child.log.read_text(encoding="utf-8").strip() == "no room"


def test_a_process_is_killed_when_its_time_is_over(tmp_path: Path) -> None:
    child, begin = _Child(tmp_path, IGNORES), time.monotonic()
    assert child.process.wait(seconds=0.2, grace=100.0) is ProcessEnd.OUT_OF_TIME
    assert 0.2 <= time.monotonic() - begin < 30.0
    assert not child.process.running


@posix
def test_a_stopped_process_may_deliver_within_its_grace(tmp_path: Path) -> None:
    child = _Child(tmp_path, DELIVERS)
    assert child.process.wait(stop=child.begun, grace=30.0) is ProcessEnd.STOPPED
    assert (child.lines, child.process.code) == (["begun", "delivered"], 4)


@posix
@pytest.mark.parametrize(("grace", "hurry"), [(0.2, False), (100.0, True)])
def test_a_process_that_does_not_end_is_killed(tmp_path: Path, grace: float, hurry: bool) -> None:
    child, begin = _Child(tmp_path, IGNORES), time.monotonic()
    assert child.process.wait(stop=child.begun, hurry=lambda: hurry, grace=grace) is ProcessEnd.STOPPED
    assert time.monotonic() - begin < 30.0
    assert child.process.code != 0


def test_a_silent_process_is_ended_and_one_that_writes_is_not(tmp_path: Path) -> None:
    assert _Child(tmp_path, SLEEPS).process.wait(silence=0.5) is ProcessEnd.SILENT
    chatter = _Child(tmp_path, CHATTERS)
    wait_until(chatter.begun)  # the start of an interpreter is silent, too
    assert chatter.process.wait(silence=0.5) is ProcessEnd.EXITED
    assert len(chatter.lines) == 6


def test_leaving_the_context_kills_the_process(tmp_path: Path) -> None:
    child = _Child(tmp_path, SLEEPS)
    with pytest.raises(ZeroDivisionError), child.process:
        raise ZeroDivisionError
    assert not child.process.running


def test_a_tethered_process_notices_that_its_parent_is_gone(tmp_path: Path) -> None:
    notices = "import sys; sys.stdin.read(); open(sys.argv[1], 'w').close()"
    parent = f"""
import os, sys
from beamline.core.process import ChildProcess
ChildProcess([sys.executable, "-c", {notices!r}, sys.argv[1]], sys.stderr, print, tether=True)
os._exit(0)
"""
    noticed = tmp_path / "noticed"
    subprocess.run([sys.executable, "-c", parent, str(noticed)], check=True, timeout=60)
    wait_until(noticed.exists)


@pytest.mark.parametrize("behind", [False, True])
def test_a_process_may_stand_behind_all_others(behind: bool) -> None:
    with ChildProcess([sys.executable, "-c", SLEEPS], sys.stderr, lambda line: None, behind=behind) as process:
        nice, ours = psutil.Process(process._process.pid).nice(), psutil.Process().nice()
        assert (nice != ours) == (behind and ours != 19)  # the last of all


def _tethered(program: str) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", program], stdin=pipe, stdout=pipe, stderr=pipe, env=environment)


ENDS_AT_ONCE = """
import os, time
from beamline.core.process import at_end_of
at_end_of(0, lambda: os._exit(1))
print("up", flush=True)
time.sleep(100)
"""
ASKS = """
import time
from beamline.core.process import EndsWithParent
from beamline.core.stop import never_stopped
with EndsWithParent(never_stopped, 0)() as should_stop:
    print("up", flush=True)
    while not should_stop():
        time.sleep(0.05)
"""
NEVER_ASKS = """
import time
from beamline.core import process
from beamline.core.stop import never_stopped
process._LAST_WORK = 0.2
scope = process.EndsWithParent(never_stopped, 0)
print("up", flush=True)
time.sleep(100)
"""


@pytest.mark.parametrize(
    ("program", "code", "said"),
    [
        (ENDS_AT_ONCE, 1, b""),
        (ASKS, 1, b"KeyboardInterrupt: this process ends, because the process that had started this one has died"),
        (NEVER_ASKS, 130, b""),
    ],
)
def test_a_process_with_a_tether_ends_when_whoever_wanted_its_result_is_gone(
    program: str, code: int, said: bytes
) -> None:
    with _tethered(program) as process:
        assert process.stdin is not None and process.stdout is not None and process.stderr is not None
        assert process.stdout.readline().strip() == b"up"
        assert process.poll() is None
        process.stdin.close()
        assert process.wait(timeout=60) in (code, -2)  # -2: POSIX tells of an interrupt by its signal
        assert said in process.stderr.read()


@pytest.mark.parametrize("host", ["lab_view", "", None])
def test_a_host_program_is_not_started_again(host: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where Python runs inside another program, the one that belongs to it does the work, with the same imports."""
    program = None if host is None else str(tmp_path / host) if host else ""
    if host:
        (tmp_path / host).write_text("", encoding="utf-8")
    monkeypatch.setattr(sys, "executable", program)
    monkeypatch.setattr(sys, "_base_executable", program, raising=False)
    monkeypatch.syspath_prepend(str(tmp_path / "imports"))
    lines: list[str] = []
    with (tmp_path / "log").open("w") as log:
        command: Any = [program, "-c", "import sys; print(sys.prefix, 'imports' in ' '.join(sys.path))"]
        with ChildProcess(command, log, lines.append) as process:
            assert process.wait(seconds=60) is ProcessEnd.EXITED
    assert lines == [f"{sys.prefix} True\n"]
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(sys, "base_prefix", str(tmp_path))
    with pytest.raises(NoPythonError, match="Set the environment variable BEAMLINE_PYTHON") as refused:
        python()
    assert repr(program) in user_message(refused.value) and exit_code(refused.value) == 2
    monkeypatch.setenv("BEAMLINE_PYTHON", "/opt/python")
    assert python() == "/opt/python"
