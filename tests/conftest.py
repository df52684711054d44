"""Fixtures shared by all tests."""

import gc
import json
import os
import signal
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import settings

from recon.compiled import ROOT  # before numba, because it sets the processor for which numba compiles

# isort: split
import numba

from recon.compiled import LEVELS, level_for, processor_flags
from recon.compiled.archive import ARCHIVE, PYTHONS, fresh_members, read_sources
from tests import messages
from tests.features import folders, table

# How many examples property tests and fuzz run: HYPOTHESIS_PROFILE=thorough pytest tests/drivers -k fuzz
# No deadline, because a busy machine sometimes makes an example slow, which is not an error of the code.
# The default draws the same examples in every run, so that the gate's verdict repeats; the other profiles explore.
settings.register_profile("few", deadline=None, derandomize=True, max_examples=25)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.register_profile("ci", deadline=None, max_examples=500, print_blob=True)
settings.register_profile("thorough", deadline=None, max_examples=10_000, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "few"))

# The suite starts some hundred processes and rewrites the asserts of 600 files; with bytecode both take half the time.
# Containers often ask for none.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# The settings that stage drivers find are stored in a separate folder for tests and the processes that they start.
_STATE = TemporaryDirectory(prefix="splatline-state-", ignore_cleanup_errors=True)
os.environ["XDG_STATE_HOME"] = os.environ["LOCALAPPDATA"] = _STATE.name


def pytest_configure(config: pytest.Config) -> None:
    """Give each worker one thread, and restore SIGINT.

    Workers share the cores. Tiny fits would wait for a second thread longer than they work, and waiting threads of
    OpenBLAS would use a core. SIGINT works as in a terminal, here and in the processes that tests start. If a script or
    a CI starts pytest in the background, SIGINT is ignored, and commands would respect that.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    config.addinivalue_line("markers", "feature: of a feature's folder, see [tool.splatline.features]")
    # `pytest` alone runs the tests of the core; a path or another -m runs what it names. Workers read the environment.
    if not hasattr(config, "workerinput"):
        alone = config.args_source is pytest.Config.ArgsSource.TESTPATHS and "not slow" in config.option.markexpr
        os.environ["SPLATLINE_CORE_ONLY"] = "1" if alone else ""
    if getattr(config.option, "numprocesses", None):
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for workers, which start later, and their processes
    if hasattr(config, "workerinput"):
        numba.set_num_threads(max(1, numba.get_num_threads() // config.workerinput["workercount"]))
        import torch  # imported here, because tests without torch start in half the time

        torch.set_num_threads(1)


_FEATURES = {folder for feature in table() for folder in folders(feature)}


@cache
def _is_of_a_feature(path: Path) -> bool:
    return not _FEATURES.isdisjoint((path, *path.parents))


# Processor seconds of the quick tests in each file that takes a second or more, as written by
# `SPLATLINE_DURATIONS=FILE pytest` in one process. Only their order matters, so another machine's values will do.
_DURATIONS = Path(__file__).parent / "durations.json"


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests of features (their folders mirror those of the features), and sort the longest files first.

    With the longest files first, all workers end at about the same time. If slow tests run, their files come first:
    a slow test at the end would leave the other workers idle.
    """
    for item in items:
        if _is_of_a_feature(item.path):
            item.add_marker("feature")
    if hasattr(config, "workerinput"):
        seconds = json.loads(_DURATIONS.read_text(encoding="utf-8"))
        asked = "not slow" not in config.option.markexpr
        slow = {item.path for item in items if asked and item.get_closest_marker("slow")}
        items.sort(key=lambda item: (item.path not in slow, -seconds.get(item.nodeid.partition("::")[0], 0.0)))


@pytest.fixture(scope="session", autouse=True)
def _temporary(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Messages name this folder as TMP."""
    messages.temporary[0] = str(tmp_path_factory.getbasetemp())


_SECONDS: defaultdict[str, float] = defaultdict(float)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Count the processor seconds of this process and of those that it has waited for."""
    before = os.times()
    done = yield
    _SECONDS[item.nodeid.partition("::")[0]] += sum(os.times()[:4]) - sum(before[:4])
    return done


def pytest_sessionfinish() -> None:
    if record := os.environ.get("SPLATLINE_DURATIONS"):
        longest = sorted(((s, name) for name, s in _SECONDS.items() if s >= 1), reverse=True)
        Path(record).write_text(
            json.dumps({name: round(s, 1) for s, name in longest}, indent=0) + "\n", encoding="utf-8"
        )


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Send all tests of a file to one worker, so that only this worker makes its fixtures and compiles its kernels.

    Slow tests are not kept together, because a few files take most of their time.
    """
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False  # it would sort by the number of tests, which says nothing about their time
    by_file = config.option.dist == "load" and "not slow" in config.option.markexpr
    return LoadFileScheduling(config, log) if by_file else None


def _kernels_are_carried() -> bool:
    """Whether the archive contains compiled code of all these sources for this processor."""
    if (
        not ARCHIVE.is_file()
        or sys.version_info[:2] not in PYTHONS
        or level_for(os.environ, processor_flags()) not in LEVELS
    ):
        return False
    return set(read_sources(ARCHIVE)) == set(fresh_members(ARCHIVE, ROOT))


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels once before the workers start, instead of in each worker (see compile_kernels)."""
    config = session.config
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    if getattr(config.option, "numprocesses", None) and whole and not _kernels_are_carried():
        halves = [
            subprocess.Popen(
                [sys.executable, "-m", "tests.compile_kernels", half], cwd=config.rootpath, stdout=subprocess.DEVNULL
            )
            for half in ("fits", "rest")
        ]
        codes = [half.wait() for half in halves]
        if any(codes):
            pytest.exit("a kernel cannot be compiled, or the simulated instrument cannot scan: see above", 1)


@pytest.hookimpl(tryfirst=True)
def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import files without a test of the requested kind, because imports take most of the collection time.

    In a run of the whole suite, these are: measurements; features, if only the core is tested; and files without a slow
    test, if slow tests and features are requested.
    """
    if [Path(argument).name for argument in config.args] != ["tests"]:
        return None
    asked = config.option.markexpr
    if "not bench" in asked and collection_path == Path(__file__).parent / "bench":
        return True
    if collection_path.suffix != ".py":
        return None
    of_a_feature = _is_of_a_feature(collection_path)
    if not asked.startswith(("slow", "(slow")):
        return True if of_a_feature and os.environ["SPLATLINE_CORE_ONLY"] else None
    if of_a_feature and "slow or feature" in asked:
        return None
    text = collection_path.read_text(encoding="utf-8")
    return None if "slow" in text or "Conformance" in text else True  # a conformance suite contains slow tests


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """Turn the garbage collector off during collection, where it took a tenth of the time."""
    if not getattr(session.config.option, "numprocesses", None):  # the workers collect, not the main process
        gc.disable()


def pytest_collection_finish() -> None:
    """Exclude everything loaded so far from garbage collection, because it lives until the end."""
    gc.freeze()
    gc.enable()


# Not in processes that tests start, because some of them run tests of another folder.
_SKIPPED = os.environ.pop("SPLATLINE_SKIPPED", None) if "PYTEST_XDIST_WORKER" in os.environ else None


def _note_skipped(report: pytest.CollectReport | pytest.TestReport) -> None:
    """Record skipped tests in the file SPLATLINE_SKIPPED, because the gate runs them again with all extras."""
    if _SKIPPED and report.skipped and not hasattr(report, "wasxfail"):
        with Path(_SKIPPED).open("a", encoding="utf-8") as file:
            file.write(report.nodeid + "\n")


pytest_runtest_logreport = pytest_collectreport = _note_skipped


SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture
def rng() -> np.random.Generator:
    """A random generator with a fixed seed, so that a failing test fails again."""
    return np.random.default_rng(20261120)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Run tiny fits on one thread: on a busy machine, waiting for a second thread takes ten times as long as the
    work."""
    import torch  # imported here, because most tests do not need it

    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    yield
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])


@pytest.fixture
def shared_data() -> Path:
    """Folder of real scans next to the checkout; tests that need it are skipped if it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip("there are no real scans next to this checkout (../shared/data)")
    return SHARED_DATA
