"""The command group: help without heavy imports, and one exit code for each kind of failure."""

import errno
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
from click.shell_completion import get_completion_class
from click.testing import CliRunner

from beamline.cli import main as module
from beamline.core import errors
from beamline.core.errors import user_message
from drivers.base.errors import DeviceError, DeviceTimeout


def _raiser(error: BaseException) -> Callable[[], None]:
    def command() -> None:
        raise error

    return command


def _run(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> click.testing.Result:
    fake = SimpleNamespace(demo=click.command("demo")(_raiser(error)))
    monkeypatch.setattr("beamline.cli.main.import_module", lambda name: fake)
    return CliRunner().invoke(module.main, ["demo"])


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (errors.ConfigError("bad key"), 2),
        (errors.InstrumentError("stage gone"), 3),
        (DeviceError("stage", "does not answer"), 3),
        (DeviceTimeout("camera", "sent no frame"), 3),
        (errors.ScanStopped("stopped at 12 of 90"), 4),
        (errors.DataError("no flats"), 5),
        (errors.QualityError("residual too large"), 6),
        (errors.BeamlineError("something"), 1),
        (OSError(errno.ENOSPC, "No space left on device", "out.h5"), 5),
        (PermissionError(errno.EACCES, "Permission denied", "out.h5"), 5),
        (MemoryError("Unable to allocate 90 GiB"), 5),
        (KeyboardInterrupt(), 130),
        (click.UsageError("what?"), 2),
    ],
)
def test_each_failure_has_its_code_and_one_sentence(
    monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int
) -> None:
    result = _run(monkeypatch, error)
    assert result.exit_code == code
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert result.stderr.strip()
    if str(error) and not isinstance(error, click.ClickException):
        assert user_message(error) in result.stderr
        assert "Errno" not in result.stderr


@pytest.mark.usefixtures("no_debug")
@pytest.mark.parametrize("error", [SystemExit(0), SystemExit(), GeneratorExit(), BaseException("odd")])
def test_what_ends_a_command_from_within_is_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    monkeypatch.chdir(tmp_path)
    result = _run(monkeypatch, error)
    assert (result.exit_code, result.stdout) == (1, "") and type(error).__name__ in result.stderr


@pytest.mark.usefixtures("no_debug")
def test_a_defect_is_one_sentence_and_a_file_with_its_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = _run(monkeypatch, ZeroDivisionError("who divides"))
    (log,) = tmp_path.iterdir()
    assert (result.exit_code, result.stdout) == (1, "")
    said = f"beamline: a defect in this program: ZeroDivisionError: who divides; the traceback is in {log}."
    assert result.stderr.startswith(said)
    assert "Traceback" not in result.stderr
    assert "in command\n    raise error" in log.read_text(encoding="utf-8")


@pytest.mark.parametrize(("arguments", "environment"), [(["--debug"], {}), ([], {"BEAMLINE_DEBUG": "1"})])
def test_a_developer_sees_the_defect_itself(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], environment: dict[str, str]
) -> None:
    fake = SimpleNamespace(demo=click.command("demo")(_raiser(ZeroDivisionError())))
    monkeypatch.setattr("beamline.cli.main.import_module", lambda name: fake)
    result = CliRunner().invoke(module.main, [*arguments, "demo"], env=environment)
    assert isinstance(result.exception, ZeroDivisionError)


@pytest.mark.parametrize("threads", ["0", "-1", "many"])
def test_a_number_of_threads_that_cannot_be_is_usage(monkeypatch: pytest.MonkeyPatch, threads: str) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    done = CliRunner().invoke(module.main, ["info", "x.h5"])
    assert done.exit_code == 2 and f"NUMBA_NUM_THREADS={threads} in the environment" in done.stderr


def test_every_command_has_its_line_in_the_page_on_commands() -> None:
    page = (Path(__file__).parents[3] / "docs" / "commands.md").read_text(encoding="utf-8")
    assert [
        name for name in module.main.list_commands(click.Context(module.main)) if f"\nbeamline {name} " not in page
    ] == []


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_commands_without_their_modules_and_their_options(
    shell: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = get_completion_class(shell)
    assert kind is not None
    completion = kind(module.main, {}, "beamline", "_BEAMLINE_COMPLETE")

    def completed(*words: str) -> list[str]:
        return [item.value for item in completion.get_completions(list(words[:-1]), words[-1])]

    assert completed("check", "--se") == ["--set"]
    monkeypatch.setattr("beamline.cli.main.import_module", None)
    assert completed("re")[:3] == ["resume", "recon", "recover"]
    assert completed("--v") == ["--version"]


def test_figures_do_not_depend_on_the_back_end_of_a_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jupyter hands its back end to what it starts, in whose environment the package may be absent."""
    monkeypatch.setenv("MPLBACKEND", "module://absent.backend_inline")
    code = (
        "import sys; sys.argv = ['beamline', '--version']; import atexit; "
        "atexit.register(lambda: print(__import__('matplotlib').get_backend())); "
        "from beamline.cli.main import run; run()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.split()[-1].lower() == "agg", done.stderr
