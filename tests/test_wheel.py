"""The built wheel works on its own, in a folder far from the clone."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[1]
SHORT = ["--set", "episodes=40", "--set", "evaluation.trials=5", "--set", "evaluation.every=20"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy of the sources."""
    pytest.importorskip("setuptools", minversion="77")
    source, target = (tmp_path_factory.mktemp(name) for name in ("source", "wheel"))
    for name in ("runner", "dualtaxi", "configs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-index", "--no-deps"]
    subprocess.run(
        [*pip, "--no-build-isolation", "--wheel-dir", str(target), str(source)], check=True, text=True
    )
    (built,) = target.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of a fresh environment with the wheel; its dependencies are this environment's."""
    folder = tmp_path_factory.mktemp("venv") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-index"]
    subprocess.run([*install, "--no-deps", str(wheel)], check=True)
    paths = sysconfig.get_paths(vars={"base": str(folder), "platbase": str(folder)})
    # Only folders of packages: a clone that is installed as editable must not be found before the wheel.
    others = [path for path in sys.path if path.rstrip("/").endswith("site-packages")]
    (Path(paths["purelib"]) / "dependencies.pth").write_text("\n".join(others), encoding="utf-8")
    for kernel in ROOT.glob("runner/*/__pycache__/*.nb[ci]"):  # of the same sources: not compiled once more
        cache = Path(paths["purelib"]) / kernel.relative_to(ROOT).parent
        cache.mkdir(exist_ok=True)
        shutil.copy(kernel, cache)
    return python


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty folder outside of the clone."""
    return tmp_path_factory.mktemp("elsewhere")


def typed(python: Path, folder: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Type a command in a folder, with the wheel's `dualtaxi`."""
    program = python.with_name("dualtaxi.exe" if os.name == "nt" else "dualtaxi")
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("DUALTAXI", "PYTHON"))}
    done = subprocess.run(
        [program, *words], cwd=folder, env=kept, capture_output=True, text=True, check=False
    )
    assert done.returncode == code, f"{words}: {done.stdout}{done.stderr}"
    return done


def test_the_first_ten_minutes_need_no_clone(python: Path, folder: Path) -> None:
    where = subprocess.run(
        [python, "-c", "import runner; print(runner.__file__)"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert Path(where.strip()).is_relative_to(python.parents[1])

    def dualtaxi(*words: str, code: int = 0) -> str:
        return typed(python, folder, *words, code=code).stdout

    dualtaxi("run", "quick", *SHORT)
    assert "quick" in dualtaxi("ls")
    assert "finished" in dualtaxi("show", "@latest")
    assert "taxi 1" in dualtaxi("play", "@latest")
    assert dualtaxi("qtable", "@latest", "--episode", "20", "--state", "300")
    assert "reproduced" in dualtaxi("verify", "@latest")
    dualtaxi("run", "quick", *SHORT, "--seed", "1", "--name", "other")
    assert dualtaxi("diff", "quick@latest", "other@latest", "--first", code=1)

    names = [each["name"] for each in json.loads(dualtaxi("config", "ls", "--json"))["configs"]]
    assert {"quick", "hyperparameters"} <= set(names)
    assert len(names) == len([*ROOT.glob("configs/**/*.yaml")])
    dualtaxi("config", "copy", "quick", "-o", "mine.yaml")
    dualtaxi("run", "mine.yaml", *SHORT)
    dualtaxi("sweep", "run", "modes", "--dry-run")
    dualtaxi("init", "start")
    typed(python, folder / "start", "run", "configs/quick.yaml", *SHORT)
    assert len([*(folder / "start" / "recordings").glob("*/recording.mcap")]) == 1


def test_a_missing_extra_is_installed_from_the_same_wheel(python: Path, wheel: Path, folder: Path) -> None:
    code = "from runner.util.extras import install_command; print(install_command('plots'))"
    advice = subprocess.run(
        [python, "-c", code], cwd=folder, capture_output=True, text=True, check=True
    ).stdout
    assert advice.strip() == f"{python} -m pip install 'dualtaxi[plots] @ {wheel.as_uri()}'"
