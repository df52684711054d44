"""What an extension costs: dummies, one of each kind, added to a copy of the project, work with their own files and one
line each in a registry.

The copy holds the packages and nothing else. For each kind, the files outside the dummy's own that had to change are
counted, and the lines in them; without these lines the dummy is unknown.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.extension_dummies import EXTENSIONS

ROOT = Path(__file__).parents[1]
PACKAGES = ("beamline", "recon", "drivers", "simulators", "configs")


# Each proof in a namespace of its own; the last line printed says which failed, and how.
_PROVE = """
import json, sys, traceback
import beamline
assert beamline.__file__.startswith(sys.argv[1]), beamline.__file__
failed = {}
for kind, proof in json.load(sys.stdin).items():
    try:
        exec(proof, {})
    except Exception:
        failed[kind] = traceback.format_exc()
print(json.dumps(failed))
"""


@pytest.mark.slow
def test_an_extension_is_its_own_files_and_one_line_of_each_registry(tmp_path: Path) -> None:
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("*.nb?", "*.pyc.*"))
    for extension in EXTENSIONS.values():
        for name, text in extension.files.items():
            path = tmp_path / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
    by_line = {kind for kind, extension in EXTENSIONS.items() if extension.lines}
    assert _failed(tmp_path).keys() == by_line == EXTENSIONS.keys() - {"stage"}  # a stage enters by its folders
    for extension in EXTENSIONS.values():
        for name, above, line in extension.lines:
            path = tmp_path / name
            text = path.read_text(encoding="utf-8")
            assert text.count(above + "\n") == 1, f"{name} has no line {above!r}"
            path.write_text(text.replace(above + "\n", f"{above}\n{line}\n"), encoding="utf-8")
        assert len(extension.lines) <= 1
        assert all("\n" not in line for *_, line in extension.lines)
    assert not (failed := _failed(tmp_path)), "\n".join(failed.values())


def _failed(copy: Path) -> dict[str, str]:
    """Traceback by kind of the proofs that fail; all in one process, as most of the time goes into imports."""
    path = os.pathsep.join(map(str, (copy, ROOT)))  # the tests' helpers come from the checkout
    environment = os.environ | {"PYTHONPATH": path, "NUMBA_DISABLE_JIT": "1"}  # nothing here is worth compiling
    proofs = json.dumps({kind: extension.proof for kind, extension in EXTENSIONS.items()})
    command = [sys.executable, "-c", _PROVE, str(copy)]
    done = subprocess.run(
        command, cwd=copy, env=environment, input=proofs, capture_output=True, text=True, timeout=200, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    failed: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    return failed
