"""Foreign modules with the names of our packages are reported in one line before anything else is imported."""

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy
import pytest

import recon
from beamline.core import installed
from beamline.core.errors import INTERRUPTED, exit_code, is_defect, user_message
from recon.base.registry import LibraryError, loaded

ROOT = Path(__file__).parents[3]


def run(script: Path, first: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(first), str(ROOT)])}
    return subprocess.run([sys.executable, script], capture_output=True, text=True, env=environment)


def test_here_all_are_ours() -> None:
    assert installed.package_problem(str(ROOT)) == ""


def test_a_script_of_the_user_by_the_name_of_a_package(tmp_path: Path) -> None:
    """As an ImportError for Python, and as one line for a command."""
    (tmp_path / "recon.py").write_text("print('mine')\n", encoding="utf-8")
    script = tmp_path / "study.py"
    script.write_text("import beamline.api\n", encoding="utf-8")
    command = tmp_path / "beamline"
    command.write_text("from beamline.cli.main import run\n", encoding="utf-8")
    told = run(script, tmp_path).stderr.splitlines()[-1]
    ours = ROOT / "recon/__init__.py"
    expected = f"Python finds 'recon' at {tmp_path / 'recon.py'} instead of the module of splatline at {ours}"
    assert told == f"ImportError: {expected}: rename that file or folder, or work in another folder."
    done = run(command, tmp_path)
    assert (done.stdout, done.stderr, done.returncode) == ("", told.replace("ImportError", "beamline") + "\n", 2)


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A site-packages with our packages and another distribution's package `drivers`."""
    site = tmp_path / "site-packages"
    for name in installed.OWN_PACKAGES:
        (site / name).mkdir(parents=True)
        text = '"""Motors."""\n' if name == "drivers" else '"""Of splatline."""\n'
        (site / name / "__init__.py").write_text(text, encoding="utf-8")
        module = ModuleType(name)
        module.__file__ = str(site / name / "__init__.py")
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(sys, "path", [str(site)])
    return site


def test_a_distribution_that_has_overwritten_a_package(environment: Path) -> None:
    told = installed.package_problem(str(environment))
    assert told.startswith(
        f"{environment / 'drivers/__init__.py'} is not splatline's: this package belongs to another distribution"
    )


BROKEN = {
    "symbol": ("raise ImportError('libtorch_cpu.so: undefined symbol: iJIT_NotifyEvent')", "iJIT_NotifyEvent"),
    "library": ("raise OSError('libcudnn.so.9: cannot open shared object file')", "libcudnn.so.9"),
    "inner": ("import a_library_that_is_not_there", "a_library_that_is_not_there"),
    "value": ("raise ValueError('numpy.dtype size changed')", "numpy.dtype size changed"),
}


def failing(code: str, folder: Path, monkeypatch: pytest.MonkeyPatch, name: str = "broken") -> Exception:
    """The error of `recon.base.registry.loaded` for a library with this code."""
    (folder / name).mkdir(exist_ok=True)
    (folder / name / "__init__.py").write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(str(folder))
    with pytest.raises(LibraryError) as failed:
        loaded(name)
    return failed.value


@pytest.mark.parametrize(("code", "why"), BROKEN.values(), ids=BROKEN)
def test_a_library_that_cannot_be_loaded_is_no_defect(
    code: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is told by its name, its place, the cause, and what to do."""
    error = failing(code, tmp_path, monkeypatch)
    for each in (error, error.__cause__):
        assert each is not None and exit_code(each) == 2 and not is_defect(each)
    told = user_message(error)
    assert told.startswith("the library 'broken' cannot be loaded (") and why in told
    assert (
        f"Python finds a library of this name at {tmp_path / 'broken' / '__init__.py'}. If the library there is a"
        in told
    )


def test_an_installed_library_is_installed_again_and_a_missing_one_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site-packages"
    site.mkdir()
    told = user_message(failing("raise OSError('no libgomp')", site, monkeypatch))
    assert told.endswith("Install it again: pip install --force-reinstall broken.")
    with pytest.raises(ModuleNotFoundError) as failed:
        import a_library_that_is_not_there  # type: ignore[import-not-found]  # noqa: F401
    assert user_message(failed.value).endswith("Install it: pip install a_library_that_is_not_there.")


def test_an_error_of_ours_stays_a_defect(tmp_path: Path) -> None:
    """Also one in a call of a library, and one of a name that our own module lacks."""
    for code in ("from beamline.core import nothing", "import recon.no_such_module", "np.zeros('many')", "recon.none"):
        with pytest.raises(Exception) as failed:
            exec(code, {"np": numpy, "recon": recon})
        assert is_defect(failed.value), code


@pytest.mark.parametrize(("name", "said"), [("numpy", "hides the library 'numpy'"), ("email", "the library 'email'")])
def test_a_file_of_the_user_by_the_name_of_a_library(name: str, said: str, tmp_path: Path) -> None:
    """A command says it in a line, also before it has a command."""
    file = tmp_path / f"{name}.py"
    file.write_text("", encoding="utf-8")
    command = tmp_path / "beamline"
    command.write_text("from beamline.cli.main import run\nrun()\n", encoding="utf-8")
    done = run(command, tmp_path)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert said in done.stderr and str(file) in done.stderr and "rename that file or folder" in done.stderr


def test_ctrl_c_while_a_library_is_loaded_is_no_broken_library(tmp_path: Path) -> None:
    (tmp_path / "click").mkdir()
    (tmp_path / "click" / "__init__.py").write_text("raise KeyboardInterrupt", encoding="utf-8")
    command = tmp_path / "beamline"
    command.write_text("from beamline.cli.main import run\nrun()\n", encoding="utf-8")
    done = run(command, tmp_path)
    assert (done.returncode, done.stderr) == (INTERRUPTED, "beamline: interrupted\n")


@pytest.mark.parametrize(
    ("name", "text", "package"),
    [
        ("serial", "class Model: ...", "pyserial"),
        ("usb", "", "pyusb"),
        ("usb", "raise ImportError('no backend')", "pyusb"),
    ],
)
def test_a_package_in_the_place_of_one_that_drivers_need(name: str, text: str, package: str, tmp_path: Path) -> None:
    site = tmp_path / "site-packages"
    (site / name).mkdir(parents=True)
    (site / name / "__init__.py").write_text(text, encoding="utf-8")
    command = tmp_path / "beamline"
    imports = {"serial": "simulators.wires.wire", "usb": "drivers.dcam.session"}
    command.write_text(f"import beamline, {imports[name]}\n", encoding="utf-8")
    done = run(command, site)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert f"the library {name!r} cannot be loaded" in done.stderr
    assert done.stderr.endswith(f"Install it again: pip install --force-reinstall {package}.\n")


@pytest.mark.parametrize("name", ["drivers", "recon"])
def test_a_folder_of_the_lab_beside_ours_adds_its_modules(name: str, tmp_path: Path) -> None:
    """Without an __init__.py of its own, with which it hides ours."""
    (tmp_path / name).mkdir()
    (tmp_path / name / "of_the_lab.py").write_text("here = 'theirs'\n", encoding="utf-8")
    script = tmp_path / "study.py"
    script.write_text(f"from {name}.of_the_lab import here\nimport beamline.api\nprint(here)\n", encoding="utf-8")
    assert run(script, tmp_path).stdout == "theirs\n"
