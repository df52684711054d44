"""The ctypes layer against C: layout, names, errors."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.base.errors import DeviceError
from drivers.dcam import abi, codes
from tests.drivers.dcam.fake import World, compiler
from tests.messages import refused

# Bytes on 64-bit machines, as the vendor's header and two independent bindings have them.
STRUCTURES = {
    "DCAMDEV_CAPABILITY": (codes.DevCapability, 16),
    "DCAMAPI_INIT": (codes.ApiInit, 32),
    "DCAMDEV_OPEN": (codes.DevOpen, 16),
    "DCAMDEV_STRING": (codes.DevString, 24),
    "DCAMPROP_ATTR": (codes.PropAttr, 88),
    "DCAM_TIMESTAMP": (codes.TimeStamp, 8),
    "DCAMCAP_TRANSFERINFO": (codes.TransferInfo, 16),
    "DCAMBUF_FRAME": (codes.BufFrame, 64),
    "DCAMWAIT_OPEN": (codes.WaitOpen, 24),
    "DCAMWAIT_START": (codes.WaitStart, 16),
}


def test_stamps_lie_where_the_vendor_puts_them() -> None:
    frame = codes.BufFrame
    assert (frame.buffer.offset, frame.timestamp.offset, frame.framestamp.offset) == (16, 48, 56)


def test_layout_is_that_of_a_c_compiler(world: World) -> None:
    c_layout = world.layout()
    declared = {value for value in vars(codes).values() if isinstance(value, type(ctypes.Structure))}
    assert {structure for structure, _ in STRUCTURES.values()} == declared  # none is left out
    assert set(c_layout) == set(STRUCTURES)
    for name, (structure, size) in STRUCTURES.items():
        offsets = [getattr(structure, field).offset for field, *_ in structure._fields_]
        assert (ctypes.sizeof(structure), offsets) == (size, c_layout[name][1]) == (c_layout[name][0], offsets), name


def test_a_missing_library_is_named_with_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"camera: .*nowhere\.so.*vendor's DCAM-API"):
        abi.Dcam(tmp_path / "nowhere.so", "camera")


def test_a_library_in_the_working_folder_is_loaded(
    fake_library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "libgood.so").write_bytes(fake_library.read_bytes())
    monkeypatch.chdir(tmp_path)
    abi.Dcam(Path("libgood.so"), "camera")


def test_the_installed_library_has_the_vendor_s_name_on_each_system() -> None:
    assert [abi.installed_library(platform) for platform in ("win32", "linux")] == ["dcamapi.dll", "libdcamapi.so"]


MODULE = "extern int fakedcam_live(void); int live_of_the_module(void) { return fakedcam_live(); }"
LOADED_FIRST = """
import ctypes, sys
from pathlib import Path
if sys.argv[3] == "driver":
    from drivers.dcam.abi import Dcam
    Dcam(Path(sys.argv[1]), "camera")
else:
    ctypes.CDLL(sys.argv[1])
print(ctypes.CDLL(sys.argv[2], mode=2).live_of_the_module())  # RTLD_NOW
"""


@pytest.mark.parametrize(("by", "works"), [("driver", True), ("ctypes", False)])
def test_modules_of_the_library_find_its_symbols(fake_library: Path, tmp_path: Path, by: str, works: bool) -> None:
    """The vendor's camera modules are loaded later and want symbols of the main library; ctypes' default hides them."""
    source, module = tmp_path / "module.c", tmp_path / "libmodule.so"
    source.write_text(MODULE)
    subprocess.run([compiler(), "-shared", "-fPIC", str(source), "-o", str(module)], check=True)
    command = [sys.executable, "-c", LOADED_FIRST, str(fake_library), str(module), by]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
    assert (ran.returncode == 0 and ran.stdout.strip() == "0") is works, ran.stderr
    assert works or "undefined symbol: fakedcam_live" in ran.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="the installed library's name is tested on Linux")
def test_without_a_path_the_installed_library_is_looked_for() -> None:
    try:
        ctypes.CDLL("libdcamapi.so")
    except OSError:
        with refused(DeviceError):
            abi.Dcam(None, "camera")
    else:
        pytest.skip("the vendor's library is installed here")


FATAL = {  # "did not finish starting" and "ends every process that loads it" stand in docs/faults.md
    "crashes": ("int dcamapi_init(void *p) { return *(volatile int *)0; }", r"ends every process .*code (-11|1)\b"),
    "crashes as it is loaded": (
        "__attribute__((constructor)) void on(void) { __builtin_trap(); }",
        "ends every process",
    ),
    "ends the program": ("void exit(int); int dcamapi_init(void *p) { exit(0); }", r"ends every process .*code 0\)"),
    "hangs": ("int pause(void); int dcamapi_init(void *p) { for (;;) pause(); }", "did not finish starting within 1 s"),
    "hangs as it is loaded": (
        "int pause(void); __attribute__((constructor)) void on(void) { for (;;) pause(); }",
        "did not finish starting within 1 s",
    ),
}


@pytest.mark.parametrize("what", FATAL)
def test_a_library_that_would_end_or_hang_this_process_is_refused(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, words = FATAL[what]
    if words.endswith("1 s"):
        monkeypatch.setattr(abi, "STARTS_WITHIN", 1.0)
    source, library = tmp_path / "fatal.c", tmp_path / "libfatal.so"
    source.write_text(text)
    command = [compiler(), "-w", "-shared", "-fPIC", str(source), "-o", str(library)]
    subprocess.run(command, check=True)
    with pytest.raises(DeviceError, match=rf"library .*libfatal\.so {words}.*vendor's DCAM-API.*a separate process"):
        abi.Dcam(library, "camera")


def test_a_program_with_a_python_of_its_own_goes_without_the_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/opt/host/program")
    abi.try_out("libfatal-that-nobody-loads.so", "camera")


def test_a_library_that_lacks_another_names_it(tmp_path: Path) -> None:
    needed, library = tmp_path / "libneeded.so", tmp_path / "libneeds.so"
    for file, text, more in (
        (needed, "int gone(void) { return 0; }", ()),
        (library, "int gone(void); int dcamapi_init(void *p) { return gone(); }", (f"-L{tmp_path}", "-lneeded")),
    ):
        file.with_suffix(".c").write_text(text)
        command = [compiler(), "-w", "-shared", "-fPIC", str(file.with_suffix(".c")), "-o", str(file), *more]
        subprocess.run(command, check=True)
    needed.unlink()
    with pytest.raises(
        DeviceError, match=r"needs libneeded\.so, which was not found .*Install the package that contains libneeded\.so"
    ):
        abi.Dcam(library, "camera")


@pytest.mark.parametrize(
    ("at", "byte", "words"),
    [(4, 1, "the library is built for 32-bit programs"), (18, 0xF3, "the library was built for another processor")],
)
def test_a_library_for_another_computer_is_named(
    fake_library: Path, tmp_path: Path, at: int, byte: int, words: str
) -> None:
    data, library = bytearray(fake_library.read_bytes()), tmp_path / "libother.so"
    data[at] = byte  # the class and the processor of an ELF file
    library.write_bytes(data)
    with pytest.raises(DeviceError, match=rf"cannot be loaded: {words}"):
        abi.Dcam(library, "camera")


def test_a_library_of_another_kind_is_refused_with_the_missing_calls(fake_library: Path, tmp_path: Path) -> None:
    source, library = tmp_path / "old.c", tmp_path / "libold.so"
    source.write_text("int dcamapi_init(void *p) { return p != 0; }\n")
    subprocess.run([compiler(), "-shared", "-fPIC", str(source), "-o", str(library)], check=True)
    with refused(DeviceError):
        abi.Dcam(library, "camera")


@pytest.mark.parametrize("code", [0x80000106, 0x80000106 - 2**32])
def test_errors_have_names_for_either_sign(code: int) -> None:
    assert codes.error_name(code) == "TIMEOUT (0x80000106)"


def test_an_unknown_error_keeps_its_number() -> None:
    error = abi.DcamError("camera", "dcamcap_start", -1)
    assert "error 0xFFFFFFFF" in str(error)
    assert error.code == 0xFFFFFFFF


def test_a_call_before_the_session_is_an_error_by_name(world: World) -> None:
    with refused(abi.DcamError):
        abi.Dcam(world.path, "camera").dev_open(0)


def test_a_wrong_size_field_is_seen_by_the_library(world: World) -> None:
    """The fake checks sizes as the real one does; that the other tests pass therefore means something."""
    library = ctypes.CDLL(str(world.path))
    library.dcamapi_init.restype = ctypes.c_int32
    assert library.dcamapi_init(ctypes.byref(codes.ApiInit(size=8))) & 0xFFFFFFFF == codes.Error.INVALIDPARAM
