"""Optional packages: import one, or explain how to install it the way the project was installed."""

from __future__ import annotations

import importlib
import json
import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from runner.errors import MissingExtra
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


def install_command(extra: str) -> str:
    """Return the command that installs an extra, by the tool that installed the project.

    `direct_url.json` (PEP 610) names a clone, a wheel or a repository; there is none if it is from an index.
    """
    from importlib import metadata  # takes 10 ms to load

    code = Path(__file__).parents[1]
    try:
        distribution = metadata.distribution(_PROJECT)
    except metadata.PackageNotFoundError:
        return _command("pip", _clone(code, extra))  # a clone on the path, not installed
    origin: Json = json.loads(distribution.read_text("direct_url.json") or "{}")
    url = str(origin.get("url", ""))
    if origin.get("dir_info", {}).get("editable"):
        from urllib.parse import urlsplit
        from urllib.request import url2pathname

        clone = Path(url2pathname(urlsplit(url).path))
        return _command(_installer(distribution), _clone(clone, extra))
    if not url and (code / "pyproject.toml").is_file():
        return _command(_installer(distribution), _clone(code, extra))
    wanted = f"{_PROJECT}[{extra}]"
    if "vcs_info" in origin:
        vcs = origin["vcs_info"]
        wanted += f" @ {vcs.get('vcs', 'git')}+{url}@{vcs.get('commit_id', '')}"
    elif url:
        wanted += f" @ {url}"
    else:
        wanted += f"=={distribution.version}"
    return _command(_installer(distribution), [wanted])


def _installer(distribution: Distribution) -> str:
    """Return the tool that installed the project: `pipx`, `uv tool`, `uv` or `pip`."""
    prefix = Path(sys.prefix)
    if (prefix / "pipx_metadata.json").exists():
        return "pipx"
    if (prefix / "uv-receipt.toml").exists():
        return "uv tool"
    return "uv" if (distribution.read_text("INSTALLER") or "").strip() == "uv" else "pip"


def _command(installer: str, requirement: list[str]) -> str:
    """Return the command line that installs a requirement into this environment."""
    python = _short(Path(sys.executable))
    words = {
        "pip": [python, "-m", "pip", "install"],
        "uv": ["uv", "pip", "install", "--python", python],
        "pipx": ["pipx", "install", "--force"],
        "uv tool": ["uv", "tool", "install", "--force"],
    }[installer]
    if installer in ("pip", "uv") and requirement[0] == "--editable":
        clone = Path(requirement[1].partition("[")[0])
        if (clone / "constraints.txt").is_file():  # the versions it is tested with
            words += ["--constraint", os.fspath(clone / "constraints.txt")]
    return shlex.join([*words, *requirement])


def _clone(clone: Path, extra: str) -> list[str]:
    """Return the arguments that install an extra of a clone."""
    return ["--editable", f"{_short(clone)}[{extra}]"]


def _short(path: Path) -> str:
    """Return a path, relative to the current folder if it is inside it."""
    here = Path.cwd()
    return os.fspath(path.relative_to(here)) if path.is_relative_to(here) else os.fspath(path)
