"""The mark of a run that this user recorded: a file next to its recording, made with a key of the user's.

    recordings/k3v9m2xq/trust.json       what may be made again as recorded, and where its modules were

The mark covers how the environments were made, and what is known on this machine alone: the folders of
`sys.path` with the user's own modules, and the script. Without the key nobody can make one, so a recording
that came from elsewhere has none that holds. The key is in the user's data folder, and nowhere else.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import json
import os
import secrets
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

from runner.recording.maker import EnvironmentMaker
from runner.util.files import is_installed, open_regular, read_object, write_object
from runner.util.values import JsonView

MARK_FILE: Final = "trust.json"
KEY_FILE: Final = "trust.key"
_KEY_BYTES: Final = 32
_MAX_BYTES: Final = 1 << 20
_NOT_COVERED: Final = ("packages", "platform", "machine", "action_names", "agent_action_names")
"""Fields of a maker that do not say how the environment is made."""
_marks_nothing = False


@dataclass(frozen=True)
class TrustMark:
    """What a run's mark states."""

    environments: tuple[str, ...] = ()
    """Digests of how its environments were made."""
    folders: tuple[str, ...] = ()
    """The user's own folders in `sys.path`, if modules of the environment were found there."""
    script: str = ""
    """The absolute path of the script whose classes an environment needs; empty if it needs none."""
    script_digest: str = ""
    """SHA-256 of the script as it was then, in hexadecimal."""


def environment_of_job(config: JsonView) -> JsonView:
    """Return what makes the environment of a job with this configuration."""
    env = config.get("env")
    env = env if isinstance(env, Mapping) else {}
    kwargs = env.get("kwargs")
    return {
        "id": env.get("id"),
        "kwargs": kwargs if isinstance(kwargs, Mapping) else {},
        "rewards": config.get("rewards"),
    }


def mark(folder: Path, environment: EnvironmentMaker | JsonView | None) -> None:
    """Mark a run of this process, in addition to what is marked already.

    It stays without a mark, and needs `--trust`, where the key or the file cannot be written.

    Args:
        folder: of the run.
        environment: its maker, or of a job the result of `environment_of_job`.
    """
    if environment is None or _marks_nothing or (key := _key(True)) is None:
        return
    text = _canonical(environment)
    before = mark_of(folder)
    digest = hashlib.sha256(text.encode()).hexdigest()
    if digest in before.environments:
        return
    folders, script = _own_places(text)
    _write(folder, [TrustMark((digest,), tuple(folders), script, _digest_of(script)), before], key)


def merge_marks(folder: Path, others: list[Path]) -> None:
    """Add to a run's mark what the marks in other folders state; invalid marks state nothing."""
    marks = [mark_of(place) for place in (folder, *others)]
    if any(mark.environments for mark in marks) and (key := _key(False)) is not None:
        _write(folder, marks, key)


def mark_of(folder: Path, name: str = MARK_FILE) -> TrustMark:
    """Return what the mark in a folder states; nothing if none was made there with this user's key."""
    with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
        values = read_object(folder / name, _MAX_BYTES)
        seal = values.pop("seal")
        key = _key(False)
        if key is not None and hmac.compare_digest(str(seal).encode(), _seal(values, key).encode()):
            lists = {key: tuple(values[key]) for key in ("environments", "folders")}
            return TrustMark(**(values | lists))
    return TrustMark()


def own_mark(recording: Path, environment: EnvironmentMaker | JsonView) -> TrustMark | None:
    """Return the mark next to a recording if it covers an environment; None if it does not."""
    marks = (mark_of(recording.parent, name) for name in (MARK_FILE, _restored_name(recording)))
    digest = hashlib.sha256(_canonical(environment).encode()).hexdigest()
    return next((mark for mark in marks if digest in mark.environments), None)


def copy_mark(folder: Path, restored: Path) -> None:
    """Put the mark of a run, if it has one, next to its recording that was restored into the cache."""
    copy = restored.with_name(_restored_name(restored))
    with contextlib.suppress(OSError, ValueError):
        try:
            write_object(copy, read_object(folder / MARK_FILE, _MAX_BYTES))
        except FileNotFoundError:
            copy.unlink(missing_ok=True)


@contextlib.contextmanager
def marking_nothing(is_strange: bool) -> Iterator[None]:
    """Leave runs that the block begins without a mark, if they are made from an untrusted run."""
    global _marks_nothing  # noqa: PLW0603 - recorders begin far below the block
    before, _marks_nothing = _marks_nothing, _marks_nothing or is_strange
    try:
        yield
    finally:
        _marks_nothing = before


# --- help ---------------------------------------------------------------------------------------------


def _restored_name(recording: Path) -> str:
    """Return the name of the mark next to a recording in the cache, where others are too."""
    return f"{recording.stem}.{MARK_FILE}"


def _canonical(environment: EnvironmentMaker | JsonView) -> str:
    """Return JSON of what makes an environment; empty values are left out."""
    if isinstance(environment, EnvironmentMaker):
        environment = vars(environment) | {"vector": environment.vector and vars(environment.vector)}
    covered = {name: value for name, value in environment.items() if value and name not in _NOT_COVERED}
    return json.dumps(covered, sort_keys=True)


def _own_places(text: str) -> tuple[list[str], str]:
    """Return the user's folders in `sys.path` if the environment needs a module there, and its script."""
    main = sys.modules.get("__main__")
    script = getattr(main, "__file__", None)
    named = {part.partition(":")[0].partition(".")[0] for part in text.split('"') if ":" in part}
    modules = {top: sys.modules.get(top) for top in named}  # of texts such as `package.module:name`
    if script and Path(script).stem in modules:  # `make="train:make_env"` names the script by its module
        modules[Path(script).stem] = main
    if all(is_installed(place) for module in modules.values() for place in _places(module)):
        return [], ""
    paths = (os.path.abspath(path) for path in sys.path)  # noqa: PTH100 - links stay what they are
    folders = [path for path in paths if not is_installed(path) and Path(path).is_dir()]
    return folders, os.path.abspath(script) if script and "__main__" in modules else ""  # noqa: PTH100


def _places(module: object) -> list[str]:
    """Return the file of a module, or the folders of a package without one; none of what has neither."""
    file = getattr(module, "__file__", None)
    return [str(file)] if file else list(map(str, getattr(module, "__path__", ())))


def _digest_of(script: str) -> str:
    with contextlib.suppress(OSError), open_regular(script) as stream:  # "" is no file
        return hashlib.sha256(stream.read()).hexdigest()
    return ""


def _seal(values: Mapping[str, object], key: bytes) -> str:
    text = json.dumps(values, sort_keys=True)
    return hashlib.blake2b(text.encode(), key=key, digest_size=32, person=b"dualtaxi.mark").hexdigest()


def _write(folder: Path, marks: list[TrustMark], key: bytes) -> None:
    """Replace a run's mark by the union of these; the first script among them counts."""
    script = next((mark for mark in marks if mark.script), TrustMark())
    values: dict[str, object] = {
        "environments": list(dict.fromkeys(digest for mark in marks for digest in mark.environments)),
        "folders": list(dict.fromkeys(path for mark in marks for path in mark.folders)),
        "script": script.script,
        "script_digest": script.script_digest,
    }
    with contextlib.suppress(OSError, ValueError):  # a path may be no text
        write_object(folder / MARK_FILE, values | {"seal": _seal(values, key)})


def _key(is_needed: bool) -> bytes | None:
    """Return this user's key, which is made if `is_needed` and there is none; None if there is none."""
    from platformdirs import user_data_path

    path = user_data_path("dualtaxi") / KEY_FILE
    with contextlib.suppress(OSError):
        return _known_key(path)
    if is_needed:
        with contextlib.suppress(OSError):
            _make_key(path)
            return _known_key(path)
    return None


@lru_cache(4)
def _known_key(path: Path) -> bytes:
    with open_regular(path) as stream:
        key = stream.read(_KEY_BYTES + 1)
    if len(key) != _KEY_BYTES:
        raise OSError("it is no key")
    return key


def _make_key(path: Path) -> None:
    """Make a key; if another process does so too, all have the same one in the end."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    fresh = path.with_name(f".{secrets.token_hex(4)}.{path.name}")
    try:
        with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
            stream.write(secrets.token_bytes(_KEY_BYTES))
        with contextlib.suppress(FileExistsError):
            os.link(fresh, path)  # unlike a rename, it never replaces another process's key
    finally:
        fresh.unlink(missing_ok=True)
