"""Libraries are loaded completely: a signal during an import is handled after it."""

import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import FrameType

import pytest

import recon
from recon.base.registry import loaded, signals_waiting

ROOT = Path(recon.__file__).parents[1]
STEPS = 5
_LIBRARY = "import sys\nfrom tests.recon.base.test_loaded import reached\n" + "".join(
    f"reached({n})\nstep{n} = {n}\n" for n in range(STEPS)
)
reached = int  # what a library of a test calls between its steps


@pytest.mark.skipif(sys.platform == "win32", reason="a process of Windows sends itself no Ctrl-C")
@pytest.mark.parametrize("at", range(STEPS))
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_waits_for_the_end_of_an_import(
    at: int, number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(n: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt(n)

    name = f"library_of_steps_{at}_{number}"
    (tmp_path / f"{name}.py").write_text(_LIBRARY)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys.modules[__name__], "reached", lambda n: n == at and os.kill(os.getpid(), number))
    before = signal.signal(number, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            loaded(name)
        assert signal.getsignal(number) is interrupt
        assert vars(loaded(name))[f"step{STEPS - 1}"] == STEPS - 1
    finally:
        signal.signal(number, before)


def test_an_error_of_the_import_is_raised_and_handlers_are_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(ImportError):
        loaded("no_such_library")
    assert signal.getsignal(signal.SIGINT) is before


def test_threads_and_nested_imports_leave_handlers_alone() -> None:
    before = signal.getsignal(signal.SIGINT)

    def load() -> None:
        with signals_waiting():
            assert signal.getsignal(signal.SIGINT) is before

    thread = threading.Thread(target=load)
    thread.start()
    thread.join()
    with signals_waiting(), signals_waiting():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.skipif(sys.platform == "win32", reason="a process of Windows sends itself no Ctrl-C")
def test_a_first_reconstruction_that_is_interrupted_can_be_repeated() -> None:
    """At an import in whose middle numba cannot be loaded again."""
    program = """
import os, signal, sys, numpy as np, recon
class Interrupt:
    def find_spec(self, name, path, target=None):
        if name == "numba.core.types.scalars":
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
try:
    recon.reconstruct
except KeyboardInterrupt:
    print(recon.reconstruct.__name__, recon.Fbp().filter)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.stdout.split() == ["reconstruct", "hann"], done.stderr


def test_functions_import_no_library_that_cannot_be_interrupted() -> None:
    """numba and torch; scipy and Pillow can be imported again. With tensors, a function has torch already."""
    indented = re.compile(r"(?m)^ +(?:from|import) (numba|torch)\b")
    found = {
        f"{path.relative_to(ROOT).as_posix()}: {library}"
        for path in (ROOT / "recon").rglob("*.py")
        for library in indented.findall(re.sub(r"(?m)^if TYPE_CHECKING:\n(    .*\n)+", "", path.read_text("utf-8")))
    }
    assert found == {
        *(f"recon/splatting/{module}.py: torch" for module in ("gaussians", "finish", "splat")),
        "recon/features/phase.py: numba",  # settings of numba, which the kernels of its module have loaded
    }
