"""Files for installing at a facility (docs/install): wheels for machines without a network, containers, conda."""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import os
import re
import subprocess
import sys
import tomllib
import warnings
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
FILES = ROOT / "docs" / "install"
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PAGE = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
OF_CONDA = {"torch": "pytorch", "matplotlib": "matplotlib-base", "zlib-ng": "python-zlib-ng"}
"""Names that differ in conda-forge."""


def text_of(name: str) -> str:
    return (FILES / name).read_text(encoding="utf-8")


def loaded(name: str) -> ModuleType:
    """A script of the folder as a module."""
    spec = importlib.util.spec_from_file_location(f"install_{name}", FILES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    with warnings.catch_warnings():  # setuptools warns if another test has imported distutils before pip
        warnings.filterwarnings("ignore", "Setuptools is replacing distutils")
        spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def recipe() -> dict[str, Any]:
    return dict(yaml.safe_load(text_of("recipe.yaml")))


def test_the_recipe_needs_what_the_project_needs(recipe: dict[str, Any]) -> None:
    parts = [re.fullmatch(r"([\w-]+)(.*)", each) for each in PROJECT["dependencies"]]
    wanted = [f"{OF_CONDA.get(part[1], part[1])} {part[2]}" for part in parts if part]
    python, *needs = recipe["requirements"]["run"]
    assert needs == wanted and len(wanted) == len(parts)
    assert python == "python >=${{ python_min }}"
    assert PROJECT["requires-python"] == f">={recipe['context']['python_min']}"
    (backend,) = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["build-system"]["requires"]
    assert backend.replace(">", " >", 1) in recipe["requirements"]["host"]


def test_the_recipe_is_of_this_version_with_the_licences_of_what_is_vendored(recipe: dict[str, Any]) -> None:
    assert recipe["context"]["version"] == PROJECT["version"]
    assert recipe["about"]["license_file"] == PROJECT["license-files"]
    assert all((ROOT / name).is_file() for name in PROJECT["license-files"])
    assert recipe["about"]["summary"] == PROJECT["description"]
    points = [" = ".join(each) for each in PROJECT["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == points


@pytest.mark.slow
def test_the_recipe_is_rendered() -> None:
    build = pytest.importorskip("rattler_build")
    (variant,) = build.Stage0Recipe.from_file(str(FILES / "recipe.yaml")).render()
    made = variant.recipe.to_dict()
    assert made["package"] == {"name": "splatline", "version": PROJECT["version"]}
    assert made["build"]["noarch"] == "python"
    assert len(made["requirements"]["run"]) == 1 + len(PROJECT["dependencies"])


def instructions(text: str) -> list[tuple[str, str]]:
    """The instructions of a Dockerfile, with their arguments."""
    lines = re.sub(r"(?m)^#.*\n", "", text).replace("\\\n", " ")
    return [(word, " ".join(rest.split())) for word, _, rest in (line.partition(" ") for line in lines.splitlines())]


def test_the_two_images_are_made_by_the_same_lines() -> None:
    docker = instructions(text_of("Dockerfile"))
    arguments = dict(rest.split("=", 1) for word, rest in docker if word == "ARG")
    ran = [
        command.strip()
        for word, rest in docker
        if word == "RUN"
        for command in re.sub(r"--mount=\S+ ", "", rest).split("&&")
    ]
    sections = dict(re.findall(r"(?ms)^%(\w+)\n(.*?)(?=^%|\Z)", text_of("splatline.def")))
    stated = dict(line.strip().split("=", 1) for line in sections["arguments"].split("\n") if line.strip())
    lines = [" ".join(line.split()) for line in sections["post"].replace("\\\n", " ").split("\n") if line.strip()]
    for name in arguments:
        lines = [line.replace(f"{{{{ {name} }}}}", f"${name}") for line in lines]
    assert stated == arguments
    only_here = {"set -e", "export PATH=/opt/splatline/bin:$PATH", "rm -rf /src"}
    assert [line for line in lines if line not in only_here] == ran
    assert re.findall("From: (.*)", text_of("splatline.def")) == [dict(docker)["FROM"]]
    assert 'exec beamline "$@"' in sections["runscript"]


def test_an_image_has_the_torch_of_the_constraints_and_the_command_as_entry_point() -> None:
    docker = instructions(text_of("Dockerfile"))
    assert docker[-1] == ("ENTRYPOINT", '["beamline"]') and set(PROJECT["scripts"]) == {"beamline"}
    assert ("ARG", "TORCH_INDEX=https://download.pytorch.org/whl/cpu") in docker
    (made,) = [rest for word, rest in docker if word == "RUN" and "pip install" in rest]
    torch, project = re.findall(r"pip install [^&]*", made)
    assert "--no-deps" in torch and '--index-url "$TORCH_INDEX" torch' in torch
    assert all("--constraint /src/constraints.txt" in each for each in (torch, project))
    assert made.endswith("python /src/docs/install/kernels.py")  # after the installation, while / is writable
    # Nothing is looked for in the home of the user who runs it.
    assert ("ENV", "HOME=/nonexistent") in docker


def test_the_files_name_this_version_and_public_addresses_alone() -> None:
    assert set(re.findall(r"splatline[-/](\d+\.\d+\.\d+)", PAGE)) == {PROJECT["version"]}
    for path in FILES.iterdir():
        if path.is_file():
            text = path.read_text(encoding="utf-8")
            assert set(re.findall(r"https?://([^/\s\"']+)", text)) <= {"download.pytorch.org"}, path.name
            assert set(re.findall(r"(?<![\d.])\d+\.\d+\.\d+(?![\d.])", text)) <= {PROJECT["version"]}, path.name
            assert path.name in PAGE or path.name in text_of("Dockerfile"), path.name


@pytest.mark.slow
def test_kernels_of_every_method_are_compiled_while_an_image_is_built(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module, warmed = loaded("kernels"), list[tuple[str, bool]]()
    monkeypatch.setattr(module, "warm_up", lambda method, views: warmed.append((method.name, views.is_cone)))
    module.main()
    assert {name for name, cone in warmed if cone} == {name for name, cone in warmed if not cone} == {*module.names()}
    assert capsys.readouterr().out == "0 kernels were compiled; the package brought the others.\n"
    monkeypatch.undo()
    monkeypatch.setattr(module, "names", lambda: ("fbp",))
    module.main()
    assert "kernels were compiled" in capsys.readouterr().out


# Wheels for machines without a network, from an index of wheels that are made here.

_BACKEND = """
import os, zipfile
def build_wheel(wheel_directory, config_settings=None, metadata_directory=None):
    name = os.path.basename(os.getcwd()).replace("-", "_")
    needs = open("needs.txt").read()
    path = f"{name}-1.0-py3-none-any.whl"
    with zipfile.ZipFile(os.path.join(wheel_directory, path), "w") as made:
        info = f"{name}-1.0.dist-info"
        made.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\\nName: {name}\\nVersion: 1.0\\n{needs}")
        made.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n")
        made.writestr(f"{info}/RECORD", "")
    return path
"""


def source(folder: Path, *needs: str) -> Path:
    """A project with a build backend of its own, so that no index is asked for one."""
    folder.mkdir(parents=True)
    (folder / "backend.py").write_text(_BACKEND, encoding="utf-8")
    (folder / "needs.txt").write_text("".join(f"{line}\n" for line in needs), encoding="utf-8")
    build = '[build-system]\nrequires = []\nbuild-backend = "backend"\nbackend-path = ["."]\n'
    (folder / "pyproject.toml").write_text(build, encoding="utf-8")
    return folder


def publish(index: Path, name: str, version: str, *needs: str, tag: str = "py3-none-any") -> None:
    """Put a wheel into a folder that pip reads as an index."""
    base = f"{name.replace('-', '_')}-{version}"
    stated = [
        f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
        *(f"Requires-Dist: {each}\n" for each in needs),
    ]
    files = {
        "METADATA": "".join(stated),
        "WHEEL": f"Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: {tag}\n",
    }
    digests = {
        each: base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).rstrip(b"=").decode()
        for each, text in files.items()
    }
    rows = [f"{base}.dist-info/{each},sha256={digests[each]},{len(text)}\n" for each, text in files.items()]
    files["RECORD"] = "".join([*rows, f"{base}.dist-info/RECORD,,\n"])
    place = index / name
    place.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(place / f"{base}-{tag}.whl", "w") as made:
        for each, text in files.items():
            made.writestr(f"{base}.dist-info/{each}", text)
    links = [f'<a href="{path.name.replace("+", "%2B")}">{path.name}</a>' for path in sorted(place.glob("*.whl"))]
    (place / "index.html").write_text("".join(links), encoding="utf-8")


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """docs/install/wheels.py for a splatline of a few stubs, with an index of its own and one of torch."""
    module = loaded("wheels")
    own = source(tmp_path / "splatline", "Requires-Dist: torch>=2.6", "Requires-Dist: plain>=1",
                 "Requires-Dist: before; python_version < '3.12'", "Requires-Dist: since; python_version >= '3.12'",
                 "Requires-Dist: windows; sys_platform == 'win32'", "Requires-Dist: splatline-addon; extra == 'addon'",
                 "Requires-Dist: arm; platform_machine == 'aarch64'")  # fmt: skip
    add_on = source(tmp_path / "splatline-addon", "Requires-Dist: splatline", "Requires-Dist: deep[more]")
    monkeypatch.setattr(module, "local_packages", lambda extras: [own, *([add_on] if "addon" in extras else [])])
    version = re.findall(r"(?m)^torch==(.*)$", (ROOT / "constraints.txt").read_text(encoding="utf-8"))[0]
    index, of_torch = tmp_path / "index", tmp_path / "torch"
    publish(of_torch, "torch", f"{version}+cpu", "plain")
    publish(index, "torch", version, "plain", "nvidia-everything")
    publish(index, "splatline", "9.0")  # of somebody else
    for name in ("plain", "before", "since", "arm", "leaf", "nvidia-everything"):
        publish(index, name, "1.5")
    publish(index, "deep", "2.0", "leaf; extra == 'more'")
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_INDEX_URL", index.as_uri())
    return module


def names(folder: Path) -> set[str]:
    return {path.name.split("-")[0] for path in folder.glob("*.whl")}


def filled(script: ModuleType, folder: Path, *words: str) -> set[str]:
    """The names of the packages with which the script fills the folder."""
    index = (folder.parent / "torch").as_uri()
    script.main([str(folder), "--torch-index", index, *words])
    lines = (folder / script.REQUIREMENTS).read_text(encoding="utf-8").splitlines()
    return {line.split("==")[0] for line in lines}


@pytest.mark.slow
def test_a_folder_installs_without_an_index(
    script: ModuleType, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "wheels"
    python = "before" if sys.version_info < (3, 12) else "since"
    found = filled(script, folder, "--extra", "addon", "--machine", "x86_64")
    assert found == {"splatline", "splatline-addon", "torch", "plain", "deep", "leaf", python}
    assert "7 wheels" in capfd.readouterr().out
    torch = next(folder.glob("torch-*"))
    assert "+cpu" in torch.name and not list(folder.glob("nvidia*"))
    sums = (folder / script.CHECKSUMS).read_text(encoding="utf-8")
    assert {line.split("  ")[1] for line in sums.splitlines()} == {path.name for path in folder.iterdir()} - {
        "SHA256SUMS"
    }
    assert f"{hashlib.sha256(torch.read_bytes()).hexdigest()}  {torch.name}\n" in sums
    install = [sys.executable, "-m", "pip", "install", "--no-index", "--find-links", str(folder), "--require-hashes",
               "-r", str(folder / script.REQUIREMENTS), "--target"]  # fmt: skip
    subprocess.run([*install, str(tmp_path / "installed")], check=True)
    assert len(list((tmp_path / "installed").glob("*.dist-info"))) == 7
    with zipfile.ZipFile(next(folder.glob("plain-*")), "a") as changed:
        changed.writestr("plain.py", "")
    assert subprocess.run([*install, str(tmp_path / "again")], check=False).returncode != 0


@pytest.mark.slow
def test_a_folder_is_for_the_python_and_the_processor_that_are_named(script: ModuleType, tmp_path: Path) -> None:
    """pip itself asks markers of the Python that runs it."""
    assert {"since", "arm"} <= filled(script, tmp_path / "new", "--python", "3.13", "--machine", "aarch64")
    old = filled(script, tmp_path / "old", "--python", "3.11", "--machine", "x86_64")
    assert "before" in old and not {"since", "arm", "windows"} & old


@pytest.mark.slow
def test_a_torch_for_cuda_ends_it_unless_it_is_asked_for(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "PYTORCH", (tmp_path / "index").as_uri()[: -len("index")])
    (tmp_path / "cpu").symlink_to(tmp_path / "index")  # an index of processors with the wrong build
    with pytest.raises(SystemExit, match=r"pip found torch-.*which needs 1 packages of CUDA \(nvidia-everything"):
        script.main([str(tmp_path / "wheels")])
    assert names(tmp_path / "wheels") == {"splatline", "torch"}
    monkeypatch.setattr(script, "PYTORCH", "")
    script.main([str(tmp_path / "cuda"), "--torch-index", (tmp_path / "index").as_uri()])
    assert "nvidia_everything" in names(tmp_path / "cuda")


def test_a_folder_with_files_and_an_unknown_extra_are_refused(tmp_path: Path) -> None:
    (tmp_path / "wheel").touch()
    for words, why in (
        ([tmp_path], "has files"),
        ([tmp_path / "new", "--extra", "nothing"], "nothing is not an extra"),
    ):
        done = subprocess.run(
            [sys.executable, str(FILES / "wheels.py"), *map(str, words)], capture_output=True, text=True, check=False
        )
        assert done.returncode == 1 and why in done.stderr, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["wheel"]


@pytest.mark.parametrize(
    ("glibc", "newest", "n"), [("2.28", "manylinux_2_28_x86_64", 28), ("2.17", "manylinux_2_17_x86_64", 17)]
)
def test_wheels_for_older_systems_run_on_newer_ones(glibc: str, newest: str, n: int, script: ModuleType) -> None:
    tags = script.platforms("x86_64", glibc)
    assert tags[0] == newest and {"manylinux_2_5_x86_64", "manylinux1_x86_64", "linux_x86_64"} <= set(tags)
    assert len(tags) == n - 4 + 4
