"""The wheel, installed where there is no checkout: its commands work, and it holds nothing else."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = tmp_path_factory.mktemp("source")
    for name in ("labelgen", "detector", "data_manifests", "tools"):
        shutil.copytree(REPOSITORY / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", "dist", "."]
    subprocess.run(command, cwd=source, check=True, capture_output=True, timeout=300)
    [path] = (source / "dist").glob("*.whl")
    return path


@pytest.mark.slow
def test_the_wheel_holds_the_packages_and_their_data(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    packages = {name.split("/")[0] for name in names if ".dist-info" not in name}
    assert packages == {"labelgen", "detector", "data_manifests"}
    files = [path for name in packages for path in (REPOSITORY / name).rglob("*") if path.is_file()]
    data = {
        path.relative_to(REPOSITORY).as_posix()
        for path in files
        if path.suffix != ".py" and path.parent.name != "__pycache__"
    }
    assert {"labelgen/py.typed", "labelgen/geometry/body_forms.npz", "data_manifests/demo.toml"} <= data
    assert data <= set(names)


@pytest.mark.slow
def test_commands_of_an_installed_wheel(wheel: Path, tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "env"], check=True, timeout=120)
    python = tmp_path / "env" / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", str(wheel)]
    subprocess.run(install, check=True, capture_output=True, timeout=300)
    # The other packages are this environment's. Paths in PYTHONPATH do not bring its editable checkout along.
    work = tmp_path / "work"
    work.mkdir()
    env = {**os.environ, "PYTHONPATH": sysconfig.get_paths()["purelib"]}

    def run(*arguments: str) -> str:
        command = [str(python.with_name("labelgen")), *arguments]
        done = subprocess.run(command, cwd=work, env=env, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr
        return done.stdout

    where = subprocess.run(
        [python, "-c", "import labelgen; print(labelgen.__file__)"], env=env, cwd=work, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert where.stdout.startswith(str(tmp_path / "env"))
    assert "bcs-masks" in run("--help")
    run("synth", "boxcars", "--out", "tree", "--vehicles", "2", "--seed", "3")
    assert "labels" in run("boxcars", "--root", "tree", "--cameras", "all", "--all-directions", "--out", "shards")
    run("audit", "shards", "--out", "audit", "--count", "4")
    assert (work / "audit" / "index.html").is_file()
