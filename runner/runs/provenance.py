"""The provenance of a run: versions, machine, settings; it may explain a difference, and is never compared.

All of it is quick to find out; what is not, such as the state of the user's repository, is in `code`.
"""

from __future__ import annotations

import contextlib
import getpass
import os
import platform
import random
import re
import shlex
import socket
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from types import ModuleType
from typing import Final

import numpy as np
from blake3 import blake3

from runner.recording.metadata import packed_provenance
from runner.runs.redaction import is_secret_name, redacted_arguments, redacted_text
from runner.util import __version__
from runner.util.values import as_utf8

CODE_VARIABLE: Final = "DUALTAXI_CODE"
"""Set to `off`, no run records the user's code."""
VARIABLES: Final = (
    "PYTHONHASHSEED",
    "PYTHONOPTIMIZE",
    "PYTHONPATH",
    "VIRTUAL_ENV",
    "CONDA_DEFAULT_ENV",
    "OMP_*",
    "MKL_*",
    "OPENBLAS_*",
    "NUMEXPR_*",
    "NUMBA_*",
    "KMP_*",
    "GOMP_*",
    "CUDA_*",
    "CUBLAS_*",
    "CUDNN_*",
    "NVIDIA_*",
    "NCCL_*",
    "ROCR_*",
    "HIP_*",
    "HSA_*",
    "TPU_*",
    "TORCH_*",
    "TORCHINDUCTOR_*",
    "PYTORCH_*",
    "XLA_*",
    "JAX_*",
    "TF_XLA_*",
    "TF_CUDNN_*",
    "LIBTPU_*",
    "TF_DETERMINISTIC_OPS",
    "TF_ENABLE_ONEDNN_OPTS",
    "TF_FORCE_GPU_ALLOW_GROWTH",
    "RANK",
    "LOCAL_RANK",
    "WORLD_SIZE",
    "MUJOCO_GL",
    "PYOPENGL_PLATFORM",
    "SDL_VIDEODRIVER",
    "LC_ALL",
    "LANG",
    "TZ",
    "SLURM_JOB_ID",
    "SLURM_PROCID",
    "SLURM_NTASKS",
    "SLURM_CPUS_PER_TASK",
    "SLURM_JOB_PARTITION",
    "KUBERNETES_SERVICE_HOST",
    "RAY_ADDRESS",
    "DUALTAXI_CODE",
)
"""Environment variables that are recorded; those with the name of a secret never are."""
_VARIABLE: Final = re.compile("|".join(pattern.replace("*", r"\w*") for pattern in VARIABLES))
_TORCH_FLAGS: Final = {
    "deterministic_algorithms": "are_deterministic_algorithms_enabled",
    "float32_matmul_precision": "get_float32_matmul_precision",
    "threads": "get_num_threads",
    "seed": "initial_seed",
}
_JAX_FLAGS: Final = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_disable_jit",
    "jax_platforms",
    "jax_numpy_dtype_promotion",
)
_CONTAINERS: Final = re.compile(r"docker|podman|kubepods|containerd|lxc|garden")
_INSTALLED: Final = re.compile(r"(?P<name>[^-]+)-(?P<version>[^-]+)(?:-py[\d.]+)?\.(?:dist-info|egg-info)")
_COMPARED: Final = ("dualtaxi", "git", "python", "platform", "machine", "processor")
"""What may explain that a job gives another content, besides the packages."""


def provenance(with_command: bool = True) -> dict[str, str]:
    """Return versions, machine, settings and command line, as text by key."""
    return _machine() | _packages() | _settings(with_command)


def provenance_entries(with_command: bool = True) -> dict[str, str]:
    """Return the entries of the metadata record `provenance`; quick, because many runs may be short."""
    return _packed_constants() | _settings(with_command)


def is_code_wanted() -> bool:
    """Return whether the environment variable allows to record the user's code."""
    return os.environ.get(CODE_VARIABLE, "").lower() not in ("0", "off", "no", "false")


Differences = dict[str, tuple[str, str]]
"""Differences in provenance: key to (recorded, here)."""


def differing_provenance(recorded: Mapping[str, str]) -> Differences:
    """Return the differences between recorded provenance and this process's that may explain others."""
    here = provenance()
    return {
        key: (recorded.get(key, ""), here.get(key, ""))
        for key in sorted({*recorded, *here})
        if recorded.get(key) != here.get(key) and (key in _COMPARED or key.startswith("package."))
    }


@cache
def _machine() -> dict[str, str]:
    """Return what does not change during a process: the machine, and the versions of the code."""
    facts = {
        "dualtaxi": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "processor": _processor(),
        "processors": str(os.cpu_count() or ""),
        "memory": _memory(),
        "container": ", ".join(_containers()),
        **_nvidia(),
    }
    return {key: as_utf8(text) for key, text in facts.items() if text}


@cache
def _packed_constants() -> dict[str, str]:
    return packed_provenance(_machine() | _packages())


@cache
def _packages() -> dict[str, str]:
    """Return the versions of all installed distributions, by `package.NAME`.

    They are read from the names of their folders: `importlib.metadata` parses each one's metadata, which
    takes a hundred times as long.
    """
    versions: dict[str, str] = {}
    for folder in sys.path:
        with contextlib.suppress(OSError):
            for entry in sorted(path.name for path in Path(folder or ".").iterdir()):
                if match := _INSTALLED.fullmatch(as_utf8(entry)):
                    versions.setdefault(f"package.{_normalised(match['name'])}", match["version"])
                elif entry.endswith(".egg-info"):
                    for package in distributions(path=[folder]):
                        versions.setdefault(
                            as_utf8(f"package.{_normalised(package.name)}"), as_utf8(package.version)
                        )
    return dict(sorted(versions.items()))


def _normalised(name: str) -> str:
    """Return the name of a distribution as package indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _settings(with_command: bool) -> dict[str, str]:
    """Return what may change during a process: environment variables, flags, states of random generators."""
    variables = dict(os.environ)
    facts = {
        f"env.{name}": redacted_text(value, variables)
        for name, value in sorted(variables.items())
        if _VARIABLE.fullmatch(name) and not is_secret_name(name)
    }
    facts |= {"host": socket.gethostname(), "directory": "", "user": _user()}
    with contextlib.suppress(OSError):  # it was removed
        facts["directory"] = str(Path.cwd())
    if with_command and is_code_wanted():
        facts["command"] = shlex.join(redacted_arguments(sys.argv, variables))
    if hasattr(os, "sched_getaffinity"):
        facts["processors.usable"] = str(len(os.sched_getaffinity(0)))
    facts["random.state"] = _digest(np.array(random.getstate()[1], np.int64).tobytes())
    if "numpy.random" in sys.modules:
        state = np.random.get_state(legacy=False)["state"]
        if "key" in state:  # otherwise the user chose another generator
            facts["numpy.random.state"] = _digest(state["key"].tobytes() + state["pos"].to_bytes(4))
    for name, read in (("torch", _torch), ("jax", _jax)):
        if name in sys.modules:
            with contextlib.suppress(Exception):  # it may be of another version, or being imported
                facts |= dict(read(sys.modules[name]))
    return {key: as_utf8(text) for key, text in facts.items()}


def _torch(torch: ModuleType) -> Iterator[tuple[str, str]]:
    """Yield the flags and seeds of PyTorch; CUDA is not initialised for this."""
    for key, name in _TORCH_FLAGS.items():
        yield f"torch.{key}", str(getattr(torch, name)())
    yield "torch.random.state", _digest(torch.get_rng_state().numpy().tobytes())
    yield "torch.cuda", str(torch.version.cuda)
    for flag in ("deterministic", "benchmark"):
        yield f"torch.cudnn.{flag}", str(getattr(torch.backends.cudnn, flag))
    if torch.cuda.is_initialized():
        for number in range(torch.cuda.device_count()):
            yield f"gpu.{number}", str(torch.cuda.get_device_name(number))


def _jax(jax: ModuleType) -> Iterator[tuple[str, str]]:
    """Yield the settings of JAX; no backend is initialised for this."""
    for name in _JAX_FLAGS:
        if hasattr(jax.config, name):
            yield f"jax.{name.removeprefix('jax_')}", str(getattr(jax.config, name))


def _digest(data: bytes) -> str:
    return blake3(data).hexdigest()[:16]


@cache
def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return ""


def _processor() -> str:
    for line in _text("/proc/cpuinfo").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor()


def _memory() -> str:
    try:
        return f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 1e9:.1f} GB"
    except (AttributeError, ValueError, OSError):
        return ""


def _containers() -> Iterator[str]:
    """Yield what suggests that this process is in a container."""
    if Path("/.dockerenv").exists():
        yield "docker"
    if Path("/run/.containerenv").exists():
        yield "podman"
    if "KUBERNETES_SERVICE_HOST" in os.environ:
        yield "kubernetes"
    if match := _CONTAINERS.search(_text("/proc/1/cgroup")):
        yield f"cgroup {match[0]}"
    limit = _text("/sys/fs/cgroup/cpu.max").split()
    if len(limit) == 2 and all(map(str.isdecimal, limit)):
        yield f"{int(limit[0]) / max(1, int(limit[1])):g} processors"
    if (limit_bytes := _text("/sys/fs/cgroup/memory.max").strip()).isdecimal():
        yield f"{int(limit_bytes) / 1e9:.1f} GB"


def _nvidia() -> dict[str, str]:
    """Return the models of NVIDIA's GPUs and their driver, as the driver lists them; nothing is executed."""
    facts = {}
    if match := re.search(r"Kernel Module\D*([\d.]+)", _text("/proc/driver/nvidia/version")):
        facts["gpu.driver"] = match[1]
    for number, path in enumerate(sorted(Path("/proc/driver/nvidia/gpus").glob("*/information"))):
        if match := re.search(r"Model:\s*(.+)", _text(path)):
            facts[f"gpu.{number}"] = match[1].strip()
    return facts


def _text(path: str | Path) -> str:
    """Return the text of a file of the system; empty if there is none."""
    try:
        return Path(path).read_text(errors="replace")[: 1 << 16]
    except OSError:
        return ""
