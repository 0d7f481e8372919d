"""What `rec.checkpoint` accepts, as bytes: files, bytes, mappings of arrays, and on request pickles."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from runner.errors import ConfigError
from runner.loops.values import numbers_of
from runner.runs.checkpoints import MAX_NAME_LENGTH, is_checkpoint_name
from runner.util.extras import require
from runner.util.values import flatten

_MAX_KEYS: Final = 1 << 20


def content_of(name: str, value: object, pickle: bool) -> tuple[bytes | memoryview | Path, str]:
    """Return the content of a checkpoint, and its format.

    Args:
        value: bytes, the path of a file, or a mapping of arrays or tensors.

    Raises:
        ConfigError: name or value cannot be recorded.
    """
    if not is_checkpoint_name(name):
        raise ConfigError(
            f"checkpoint: found the name {str(name)[:80]!r}, expected printable text of 1 to "
            f"{MAX_NAME_LENGTH} letters without @"
        )
    if pickle:
        import pickle as pickling

        try:
            return pickling.dumps(value), "pickle"
        except Exception as error:  # whatever the object raises
            raise ConfigError(f"checkpoint: {name!r} cannot be pickled ({error})") from error
    if isinstance(value, bytes | bytearray | memoryview):
        return memoryview(value).cast("B"), "bytes"
    if isinstance(value, str | os.PathLike):
        path = Path(os.fspath(value))
        if not path.is_file():
            raise ConfigError(
                f"checkpoint: found the path {str(path)!r} for {name!r}, expected that of a file"
            )
        return path, "safetensors" if path.suffix == ".safetensors" else "file"
    if isinstance(value, Mapping):
        return _safetensors(name, flatten(value, separator="/")), "safetensors"
    raise ConfigError(
        f"checkpoint: found {type(value).__name__} for {name!r}, expected bytes, a path, or a mapping of "
        "arrays or tensors, such as model.state_dict(); pickle=True records any other object"
    )


def _safetensors(name: str, values: Mapping[str, Any]) -> bytes:
    if not 0 < len(values) <= _MAX_KEYS:
        raise ConfigError(f"checkpoint: found {len(values):,} arrays for {name!r}, expected at least one")
    torch = sys.modules.get("torch")
    is_torch = torch is not None and all(isinstance(value, torch.Tensor) for value in values.values())
    module = "safetensors.torch" if is_torch else "safetensors.numpy"
    save = require(module, extra="safetensors", purpose="a checkpoint of arrays or tensors").save
    if is_torch:  # a copy of each: tensors that share memory are refused
        return bytes(save({key: value.detach().cpu().contiguous().clone() for key, value in values.items()}))
    expected = "an array of numbers; pickle=True records any object"
    arrays = {
        key: np.array(numbers_of(value, "checkpoint", f"at {key!r} of {name!r}", expected), order="C")
        for key, value in values.items()
    }
    return bytes(save(arrays))
