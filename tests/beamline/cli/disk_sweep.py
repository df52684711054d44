"""Runs commands repeatedly in forks of this process, each time with another disk fault (tests.faulty_disk).

    LD_PRELOAD=faulty_disk.so FAULTY_DISK_PATTERN=out/ python -m tests.beamline.cli.disk_sweep FOLDER POINTS COMMAND...

FOLDER is the current directory of the commands; they write to FOLDER/out, and each is one argument. Each run prints one
JSON line: command, fault, write, exit code, stderr, the outputs by name with the SHA-256 of the content that does not
change between runs, and truncated files. Trials of `tradeoff` and `study` are replaced by ones that only write a volume
in this process. Figures are blank, because they are drawn in memory, where a disk fault has no effect.
"""

import ctypes
import errno
import gc
import hashlib
import json
import os
import shutil
import sys
from contextlib import redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from beamline.features.trials import runner
from beamline.features.trials.trial import MethodTrial, Outcome
from beamline.report import figures
from tests.beamline.conftest import BlankCanvas

_FAULTS = {
    "none": (0, 0, 0, 0),
    "EIO once": (0, 0, 1, errno.EIO),
    "ENOSPC": (0, 1, 0, errno.ENOSPC),
    "kill": (1, 0, 0, 0),
}
_MODULES = {
    "export": "features.export.command",
    "ingest": "features.files.command features.files.ingest",
    "recon": "cli.recon reconstruct.job reconstruct.pipeline reconstruct.report report.figures",
    "tradeoff": "features.trials.command features.trials.tradeoff",
    "study": "features.trials.command features.trials.tradeoff",
}
_CHANGES = ("date", "elapsed", "start_time", "end_time", "seconds", "command", "time")


def digest(path: Path) -> str:
    """Digest of the content of a file or folder; for report pages, only whether they exist."""
    found = hashlib.sha256()
    if path.is_dir():
        for part in sorted(path.rglob("*")):
            found.update(f"{part.relative_to(path)} {digest(part) if part.is_file() else ''}".encode())
    elif h5py.is_hdf5(path):
        with h5py.File(path) as file:

            def add(name: str, item: h5py.HLObject) -> None:
                found.update(f"{name} {sorted((key, str(item.attrs[key])) for key in item.attrs)}".encode())
                last = name.rsplit("/", 1)[-1]
                if isinstance(item, h5py.Dataset) and last not in _CHANGES and not last.startswith("seconds_of_"):
                    value = np.asarray(item[()])
                    found.update(str(value.tolist()).encode() if value.dtype.hasobject else value.tobytes())

            file.visititems(add)
    elif path.suffix == ".html":
        found.update(str(_whole(path)).encode())
    elif path.suffix == ".txt":  # a log
        found.update(str([line.split()[1] for line in path.read_text().splitlines()]).encode())
    else:
        found.update(path.read_bytes())
    return found.hexdigest()


def _whole(path: Path) -> bool:
    """Whether a page, table or picture is complete."""
    data = path.read_bytes()
    if path.suffix == ".json":
        with suppress(ValueError):
            return bool(json.loads(data))
        return False
    ends = {".html": b"</html>\n", ".csv": b"\n", ".png": b"IEND\xaeB`\x82"}
    return data.endswith(ends.get(path.suffix, b""))


def _made_up(trial: MethodTrial, *_: object) -> tuple[Outcome, Any]:
    """A replacement for a trial that takes no time."""
    amount = float(trial.views)
    volume = np.linspace(0, amount, 3200, dtype=np.float32).reshape(2, 40, 40)
    found = {"residual_held_out": 1 / amount, "psnr_all": amount, "ssim_all": 0.5}
    return Outcome(trial, "done", amount / 1000, int(1e6 * amount), found, cpu_seconds=amount / 1000), volume


def _done_once(words: list[str], cli: Any) -> None:
    """Run a command in this process without output."""
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        cli.main(words, prog_name="beamline", standalone_mode=False)
    gc.collect()
    gc.freeze()


def _digest_or_damaged(path: Path) -> str:
    try:
        return digest(path)
    except OSError as error:
        return f"damaged: {error}"


def main() -> None:
    folder, points, commands = Path(sys.argv[1]), int(sys.argv[2]), [line.split() for line in sys.argv[3:]]
    library = ctypes.CDLL(os.environ["LD_PRELOAD"])
    cli = import_module("beamline.cli.main")
    for words in commands:
        for module in _MODULES[words[0]].split():
            import_module(f"beamline.{module}")
    runner.run_trial = _made_up  # type: ignore[assignment,attr-defined]
    figures.canvas = BlankCanvas
    os.chdir(folder)
    out, counted = Path("out"), Path("count")

    def run(words: list[str], fault: str, n: int) -> None:
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        child = os.fork()
        if child == 0:
            for number, name in ((1, "stdout"), (2, "stderr")):
                os.dup2(os.open(name, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), number)
            kill, begin, once, error = _FAULTS[fault]
            library.faulty_disk_arm(*(ctypes.c_long(n * here) for here in (kill, begin, once)), error, 0)
            sys.argv = ["beamline", *words]
            try:
                cli.run()
            finally:
                counted.write_text(str(library.faulty_disk_count()))
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        line: dict[str, Any] = {"command": " ".join(words), "fault": fault, "n": n, "code": code}
        line["stderr"] = Path("stderr").read_text()
        line["hidden"] = sum(path.name.startswith(".") or path.name == "work" for path in out.rglob("*"))
        kept = [path for path in sorted(out.iterdir()) if not path.name.startswith(".")]
        line["outputs"] = {path.name: _digest_or_damaged(path) for path in kept}
        line["cut"] = [str(p) for p in out.rglob("[!.]*") if p.is_file() and "work" not in p.parts and not _whole(p)]
        print(json.dumps(line), flush=True)

    for words in commands:
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        _done_once(words, cli)  # modules that are loaded now need not be loaded by the forks
        run(words, "none", 0)
        writes = int(counted.read_text())
        for fault in list(_FAULTS)[1:]:
            for n in sorted(set(np.linspace(1, writes, min(points, writes)).astype(int).tolist())):
                run(words, fault, n)


if __name__ == "__main__":
    main()
