"""Nothing that Windows or macOS lack is imported, and it is called only after a platform check.

All modules are imported as on each other system: Python, its libraries and paths stay those of this one. mypy reads
what the functions call, by the stubs of the other system. What they do there is not seen here.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("beamline", "drivers", "recon", "simulators")

# A first import of all loads the libraries as of this system; then only our own modules meet the other one.
IMPORT_AS = """
import json, os, pkgutil, signal, sys, traceback, types
from importlib import import_module

PACKAGES = ("beamline", "drivers", "recon", "simulators")

def names():
    for package in PACKAGES:
        yield package
        for each in pkgutil.walk_packages(import_module(package).__path__, package + "."):
            if not each.name.endswith(".__main__"):
                yield each.name

def import_all():
    failed = {}
    for name in all_names:
        try:
            import_module(name)
        except BaseException:
            failed[name] = traceback.format_exc(limit=-2)
    return failed

def forget():
    for name in [name for name in sys.modules if name.split(".")[0] in PACKAGES]:
        del sys.modules[name]

all_names = sorted(names())
here = import_all()
absent = {name: text for name, text in here.items() if "No module named" in text}  # extras that are not installed
failed = {}
for platform, system in json.loads(sys.argv[1]).items():  # what one lacks, the next one lacks, too
    forget()
    for name in system["modules"]:
        sys.modules[name] = None  # an import of it is an ImportError
    for name in system["stubs"]:
        sys.modules[name] = types.ModuleType(name)
    for module in (os, signal):
        for name in system["attributes"]:
            if hasattr(module, name):
                delattr(module, name)
    sys.platform = platform
    failed |= {f"{platform}: {name}": text for name, text in import_all().items() if name not in absent}
print(json.dumps([len(all_names), sorted(set(here) - set(absent)), failed]))
"""

LINUX = {
    "O_PATH", "memfd_create", "posix_fadvise", "posix_fallocate", "sched_getaffinity", "sched_setaffinity",
    "splice", "pidfd_open", "eventfd", "copy_file_range", "SIGPWR", "SIGRTMIN", "SIGSTKFLT", "sigtimedwait",
}  # fmt: skip
POSIX = {
    "fork", "forkpty", "getuid", "geteuid", "getgid", "getpgid", "getpgrp", "killpg", "setsid", "setpgid", "nice",
    "statvfs", "fchmod", "fchown", "chown", "lchown", "mkfifo", "pread", "pwrite", "fdatasync", "sysconf", "uname",
    "getloadavg", "O_NOFOLLOW", "O_DIRECTORY", "O_CLOEXEC", "O_NONBLOCK", "O_SYNC", "O_DSYNC", "WNOHANG", "WIFEXITED",
    "openpty", "SIGHUP", "SIGKILL", "SIGQUIT", "SIGTSTP", "SIGCONT", "SIGSTOP", "SIGUSR1", "SIGUSR2", "SIGALRM",
    "SIGVTALRM", "SIGPROF", "SIGXCPU", "SIGPIPE", "SIGCHLD", "SIGWINCH", "setitimer", "alarm", "pause", "pthread_kill",
    "pthread_sigmask", "sigwait",
}  # fmt: skip

SYSTEMS = {
    "darwin": {"modules": ["spwd", "msvcrt", "winreg"], "stubs": [], "attributes": sorted(LINUX)},
    "win32": {
        "modules": [
            "fcntl", "termios", "resource", "pwd", "grp", "pty", "tty", "syslog", "posix", "curses", "readline",
        ],
        "stubs": ["msvcrt", "winreg", "_winapi"],
        "attributes": sorted(LINUX | POSIX),
    },
}  # fmt: skip


@pytest.mark.slow
def test_all_modules_are_imported_as_on_other_systems() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", IMPORT_AS, json.dumps(SYSTEMS)]
    done = subprocess.run(words, capture_output=True, text=True, env=environment, timeout=200)
    assert done.returncode == 0, done.stderr
    number, not_even_here, failed = json.loads(done.stdout.splitlines()[-1])
    assert number > 500 and not not_even_here
    assert not failed, "\n".join(failed.values())


@pytest.mark.slow
@pytest.mark.parametrize("platform", ["win32", pytest.param("darwin", marks=pytest.mark.long)])
def test_what_another_system_lacks_is_called_behind_a_look_at_it(platform: str) -> None:
    """In the modules that import what differs from system to system; a name of it that is not there is an error."""
    differs = re.compile(r"(?m)^\s*(import|from) (ctypes|fcntl|mmap|msvcrt|os|psutil|resource|select|signal|socket)\b")
    paths = [path for each in PACKAGES for path in sorted((ROOT / each).rglob("*.py"))]
    chosen = [path for path in paths if differs.search(path.read_text(encoding="utf-8"))]
    assert len(chosen) > 40
    words = ["--platform", platform, "--follow-imports=skip", "--no-incremental", "--ignore-missing-imports"]
    mypy = [sys.executable, "-m", "mypy", "--config-file", os.devnull, *words, *map(str, chosen)]
    done = subprocess.run(mypy, capture_output=True, text=True, cwd=ROOT, timeout=200)
    assert done.returncode in (0, 1), done.stderr
    assert not re.findall(r"(?m)^.*\[(?:attr|name)-defined\]$", done.stdout)
