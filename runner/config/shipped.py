"""The experiments that are shipped with the project, which can be named without a path.

They are in `configs/`: next to the packages in a clone, inside of `runner` in an installed wheel.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from runner.errors import RunnerError, StorageError, nearest

SCHEMA_FILE: Final = "schema.json"
_SWEEPS: Final = "sweeps"
_SCHEMA_LINE: Final = "# yaml-language-server: $schema="


class Shipped(NamedTuple):
    """A shipped experiment."""

    name: str
    kind: str
    """`experiment` or `sweep`."""
    about: str
    """The first sentence of the comment at its top."""
    path: Path

    @property
    def command(self) -> str:
        """The command that runs it."""
        return f"dualtaxi {'sweep run' if self.kind == 'sweep' else 'run'} {self.name}"


def shipped_folder() -> Path:
    """Return the folder of the shipped experiments."""
    package = Path(__file__).parents[1]
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


def shipped() -> dict[str, Shipped]:
    """Return the shipped experiments by name, sweeps after all others."""
    folder = shipped_folder()
    files = [*sorted(folder.glob("*.yaml")), *sorted(folder.glob(f"{_SWEEPS}/*.yaml"))]
    return {
        file.stem: Shipped(
            file.stem, "sweep" if file.parent.name == _SWEEPS else "experiment", _about(file), file
        )
        for file in files
    }


def _about(file: Path) -> str:
    """Return the first sentence of the comment at the top of a file."""
    words: list[str] = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("# "):
            break
        if not line.startswith(_SCHEMA_LINE):
            words += line.removeprefix("# ").split()
    sentence, stop, _ = " ".join(words).partition(". ")
    return sentence + stop.strip()


def find_shipped(name: str) -> Shipped:
    """Return the shipped experiment of a name.

    Raises:
        RunnerError: there is none; the message names the nearest.
    """
    experiments = shipped()
    if name not in experiments:
        raise RunnerError(
            f"there is no shipped experiment {name!r}.{nearest(name, experiments)} `dualtaxi config ls` "
            "lists them."
        )
    return experiments[name]


def config_path(path: str | os.PathLike[str]) -> Path:
    """Return the file of a path; of the name of a shipped experiment, unless a file has this name."""
    file = Path(path)
    if file.name == os.fspath(path) and not file.suffix and not file.is_file():
        experiments = shipped()
        if file.name in experiments:
            return experiments[file.name].path
    return file


def suggestion(path: Path) -> str:
    """Return a hint at the file or shipped experiment that a missing path probably meant."""
    try:
        files = [file.name for file in path.parent.glob("*.y*ml")]
    except OSError:
        files = []
    experiments = shipped()
    if path.stem in experiments:
        return f" A shipped experiment has this name: `{experiments[path.stem].command}`."
    if near := nearest(path.name, files):
        return near
    return f"{nearest(path.stem, experiments)} `dualtaxi config ls` lists the shipped experiments."


def copy_shipped(experiment: Shipped, target: Path) -> None:
    """Write a shipped experiment into a new file.

    The line by which editors find the schema is left out if there is no schema next to the file.

    Raises:
        RunnerError: the file exists already.
        StorageError: it cannot be written.
    """
    text = experiment.path.read_text(encoding="utf-8")
    if text.startswith(_SCHEMA_LINE) and not (target.parent / SCHEMA_FILE).exists():
        text = text.partition("\n")[2]
    try:
        if not _write_unless_there(target, text):
            raise RunnerError(f"{target}: exists already; choose another name by -o.")
    except OSError as error:
        raise StorageError(f"{target}: cannot be written: {error.strerror}.") from error


START_PAGE: Final = """\
# Experiments

`configs/` contains experiments to run and to edit, `configs/sweeps/` searches over many values. Every run is
recorded in a folder of `recordings/`. Type in this folder:

```
dualtaxi run configs/quick.yaml     # learn for a second, recording every step
dualtaxi ls                         # list the runs
dualtaxi show @latest               # evaluations, tables and configuration of the newest run
dualtaxi play @latest               # watch an episode of it
dualtaxi diff @latest OTHER         # compare two runs
dualtaxi --help                     # every command
```

`dualtaxi config check FILE` checks a configuration after your changes.
"""


def start_folder(folder: Path) -> Iterator[tuple[Path, bool]]:
    """Create a folder to start in: the shipped experiments, a folder for recordings and a short README.

    Existing files are not changed.

    Yields:
        Each file or folder, and whether it was created.

    Raises:
        StorageError: something cannot be written.
    """
    source = shipped_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file in [source / SCHEMA_FILE, *(experiment.path for experiment in shipped().values())]:
            target = folder / "configs" / file.relative_to(source)
            target.parent.mkdir(parents=True, exist_ok=True)
            yield target, _write_unless_there(target, file.read_text(encoding="utf-8"))
        recordings = folder / "recordings"
        made = not recordings.exists()
        recordings.mkdir(exist_ok=True)
        yield recordings, made
        yield folder / "README.md", _write_unless_there(folder / "README.md", START_PAGE)
    except OSError as error:
        raise StorageError(f"{error.filename or folder}: cannot be written: {error.strerror}.") from error


def _write_unless_there(target: Path, text: str) -> bool:
    """Write a file unless it exists; return whether it was written."""
    try:
        with target.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except FileExistsError:
        return False
    return True
