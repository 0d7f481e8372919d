"""What other packages add: optional packages of this project, and plugins.

An optional package that is missing is explained with the command that installs it. A package adds views and
exports by entry points of the groups `VIEWS` and `EXPORTS` in its `pyproject.toml`:

    [project.entry-points."dualtaxi.views"]
    streaks = "my_package:STREAKS"
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import shlex
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from runner.errors import MissingExtra, RunnerError
from runner.util.files import cache_folder, read_object, write_object
from runner.util.values import Json

if TYPE_CHECKING:
    from importlib.metadata import Distribution


_PROJECT: Final = "dualtaxi"
_PACKAGES: Final = {
    "PIL": "pillow",
    "rerun": "rerun-sdk",
    "rerun_notebook": "rerun-notebook",
    "resvg_py": "resvg-py",
    "sklearn": "scikit-learn",
}
"""Module -> its package, where the names differ."""


def require(*modules: str, extra: str, purpose: str) -> Any:
    """Import modules of an optional package.

    Args:
        modules: such as `scipy.stats`.
        extra: the extra of the project that installs them.
        purpose: what needs them, for the message.

    Returns:
        The first of the modules.

    Raises:
        MissingExtra: one cannot be imported.
    """
    try:
        first, *_ = [importlib.import_module(module) for module in modules]
    except ImportError as error:
        raise missing(error.name or modules[0], extra, purpose) from error
    return first


def missing(module: str, extra: str, purpose: str) -> MissingExtra:
    """Return the error for a module that is not installed; arguments as for `require`."""
    package = module.partition(".")[0]
    return MissingExtra(
        f"{purpose} needs {_PACKAGES.get(package, package)}, which is not installed. Install it by: "
        f"{install_command(extra)}"
    )


class _NoPandas:
    """Finds no pandas."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name=name)


@contextlib.contextmanager
def without_pandas() -> Iterator[None]:
    """Keep Arrow from loading pandas, which takes as long as a query, only to see whether it is there."""
    sys.meta_path.insert(0, _NoPandas)
    try:
        yield
    finally:
        sys.meta_path.remove(_NoPandas)


def install_command(extra: str) -> str:
    """Return the command that installs an extra, by the tool that installed the project.

    `direct_url.json` (PEP 610) names a clone, a wheel or a repository; there is none if it is from an index.
    """
    from importlib import metadata  # takes 10 ms to load

    code = Path(__file__).parents[1]
    try:
        distribution = metadata.distribution(_PROJECT)
    except metadata.PackageNotFoundError:
        return _command("pip", extra, clone=code)  # a clone on the path, not installed
    installer = _installer(distribution)
    origin: Json = json.loads(distribution.read_text("direct_url.json") or "{}")
    url = str(origin.get("url", ""))
    if origin.get("dir_info", {}).get("editable"):
        from urllib.parse import urlsplit
        from urllib.request import url2pathname

        clone = Path(url2pathname(urlsplit(url).path))
        return _command(installer, extra, clone)
    if not url and (code / "pyproject.toml").is_file():
        return _command(installer, extra, clone=code)
    wanted = f"{_PROJECT}[{extra}]"
    if "vcs_info" in origin:
        vcs = origin["vcs_info"]
        wanted += f" @ {vcs.get('vcs', 'git')}+{url}@{vcs.get('commit_id', '')}"
    elif url:
        wanted += f" @ {url}"
    else:
        wanted += f"=={distribution.version}"
    return _command(installer, wanted)


def _installer(distribution: Distribution) -> str:
    """Return the tool that installed the project: `pipx`, `uv tool`, `uv` or `pip`."""
    prefix = Path(sys.prefix)
    if (prefix / "pipx_metadata.json").exists():
        return "pipx"
    if (prefix / "uv-receipt.toml").exists():
        return "uv tool"
    return "uv" if (distribution.read_text("INSTALLER") or "").strip() == "uv" else "pip"


def _command(installer: str, requirement: str, clone: Path | None = None) -> str:
    """Return the command line that installs a requirement, or an extra of a clone, into this environment."""
    python = _short(Path(sys.executable))
    words = {
        "pip": [python, "-m", "pip", "install"],
        "uv": ["uv", "pip", "install", "--python", python],
        "pipx": ["pipx", "install", "--force"],
        "uv tool": ["uv", "tool", "install", "--force"],
    }[installer]
    if clone is None:
        return shlex.join([*words, requirement])
    constraints = clone / "constraints.txt"  # the versions it is tested with
    if installer in ("pip", "uv") and constraints.is_file():
        words += ["--constraint", _short(constraints)]
    return shlex.join([*words, "--editable", f"{_short(clone)}[{requirement}]"])


def _short(path: Path) -> str:
    """Return a path, relative to the current folder if it is inside it."""
    here = Path.cwd()
    return os.fspath(path.relative_to(here)) if path.is_relative_to(here) else os.fspath(path)


VIEWS: Final = "dualtaxi.views"
EXPORTS: Final = "dualtaxi.exports"
_CACHE_FILE: Final = "plugins.json"
_MAX_CACHE_BYTES: Final = 1 << 20
T = TypeVar("T")


def plugin_names(group: str) -> Mapping[str, str]:
    """Return the names in a group of entry points, and the package of each.

    Nothing is imported. Reading the metadata of all packages takes 0.1 s, so the names are cached until a
    folder of packages changes.
    """
    folders = {path: Path(path).stat().st_mtime_ns for path in sys.path if Path(path).is_dir()}
    file = cache_folder() / _CACHE_FILE
    cached: dict[str, Any] = {}
    with contextlib.suppress(OSError, ValueError):
        cached = read_object(file, _MAX_CACHE_BYTES)
    if cached.get("folders") != folders or not isinstance(cached.get(group), dict):
        from importlib.metadata import entry_points

        cached = {"folders": folders}
        for key in (VIEWS, EXPORTS):
            cached[key] = {point.name: point.dist.name for point in entry_points(group=key) if point.dist}
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_object(file, cached)
    names: dict[str, str] = cached[group]
    return names


def load_plugin(group: str, name: str, kind: type[T]) -> T:
    """Import what an entry point names.

    Raises:
        RunnerError: it cannot be imported, or is no `kind` of this name.
    """
    from importlib.metadata import entry_points

    (point, *_) = entry_points(group=group, name=name)
    package = point.dist.name if point.dist else point.value
    try:
        loaded = point.load()
    except Exception as error:
        raise RunnerError(
            f"{name}: {point.value} of the package {package} cannot be imported: "
            f"{type(error).__name__}: {error}. Update or uninstall that package."
        ) from error
    if not isinstance(loaded, kind) or getattr(loaded, "name", name) != name:
        raise RunnerError(
            f"{name}: found {loaded!r} at {point.value} of the package {package}, "
            f"expected a {kind.__name__} of this name."
        )
    return loaded
