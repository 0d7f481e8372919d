"""Logging numbers alone, without steps, against experiment trackers.

The shapes are those of MLtraq's public benchmark: one value in a run, 10,000 values in a run, and many runs
of one value each. The trackers take turns, each in a process of its own, whose first run is not counted.
The time ends when everything is written, so that a killed process would not lose it. Ours is also measured
until everything is synced to disk, as tensorboardX and trackio do for each run and MLtraq for all together.
MLflow and wandb do not sync what is logged. None of them sends anything: those that have servers log offline,
or to files. All files stay until the end, because file systems are slow after many were deleted.

Trackers know no environment, and so does `SummaryWriter`, by which ours are compared: the script is that of
tensorboardX but for the import. `runner.record` also makes an environment in each run, and describes it.

The trackers that are not installed are named; `make test-integrations` installs most of them.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.figures import Figure, figure
from benchmarks.processes import ROOT

Log = Callable[[float], object]
Run = Callable[[], contextlib.AbstractContextManager[Log]]
Track = Callable[[Path, int], contextlib.AbstractContextManager[Run]]
"""Given a folder and the number of values in a run, a context in which runs can be made.

Its end is when everything is written."""
NAMES = {
    "dualtaxi": "runner",
    "dualtaxi, synced": "runner",
    "dualtaxi, with an environment": "runner",
    "MLtraq": "mltraq",
    "tensorboardX": "tensorboardX",
    "trackio": "trackio",
    "wandb, offline": "wandb",
    "MLflow, files": "mlflow",
}
"""The trackers, and the modules that they need."""
SHAPES = (("1 value", 1, 1), ("10,000 values", 1, 10_000), ("10 runs of 1 value", 10, 1))
_ROUNDS = 3
_TOO_LONG = 30.0
"""Trackers that would take more seconds for many runs than this are left out of those."""
MANY = (("100 runs of 1 value", 100, 1), ("1,000 runs of 1 value", 1_000, 1))


def measure(quick: bool) -> list[Figure]:
    """Return the time of each shape with each tracker that is installed; ours is to be ahead of them."""
    with tempfile.TemporaryDirectory() as folder:
        return _measure(quick, Path(folder))


def _measure(quick: bool, folder: Path) -> list[Figure]:
    installed = [name for name, module in NAMES.items() if importlib.util.find_spec(module) is not None]
    figures: list[Figure] = []
    of_ten: dict[str, float] = {}
    for shape, runs, values in SHAPES if quick else (*SHAPES, *MANY):
        times: dict[str, list[float]] = {}
        for _ in range(_ROUNDS):
            for name in installed:
                if of_ten.get(name, 0.0) * runs / 10 < _TOO_LONG:
                    own = Path(tempfile.mkdtemp(dir=folder))
                    times.setdefault(name, []).extend(_times(name, runs, values, 1 if runs > 10 else 3, own))
        if runs == 10:
            of_ten = {name: min(seconds) for name, seconds in times.items()}
        medians = {
            name: statistics.median(seconds) for name, seconds in times.items() if "dualtaxi" not in name
        }
        aim = min(medians.values(), default=None)
        medians.pop("MLtraq", None)
        targets = None if aim is None or not medians else (min(medians.values()), aim)
        figures += [
            figure(
                f"{shape}, {name}",
                seconds,
                "s",
                targets if "dualtaxi" in name else None,
                higher_is_better=False,
                detail="targets: the quickest but MLtraq, and the quickest" if "dualtaxi" in name else "",
            )
            for name, seconds in times.items()
        ]
    missing = ", ".join(name for name in NAMES if name not in installed)
    if missing:
        print(f"    not installed, and left out: {missing}")
    return figures


def _times(name: str, runs: int, values: int, repetitions: int, folder: Path) -> list[float]:
    """Return the seconds that a tracker takes, in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.bench_trackers", name, str(runs), str(values)]
    quiet = {"WANDB_SILENT": "true", "WANDB_MODE": "offline", "MLFLOW_ALLOW_FILE_STORE": "true"}
    done = subprocess.run(
        [*command, str(repetitions), str(folder)],
        cwd=ROOT,
        env=os.environ | quiet | {"TRACKIO_DIR": str(folder), "HF_HUB_OFFLINE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{name} failed:\n{done.stdout}{done.stderr}")
    seconds: list[float] = json.loads(done.stdout.splitlines()[-1])
    return seconds


@contextlib.contextmanager
def _dualtaxi_synced(folder: Path, values: int) -> Iterator[Any]:
    from runner.recording.writer import SYNCER

    with _dualtaxi(folder, values) as run:
        yield run
    SYNCER.sync()


def _dualtaxi(folder: Path, _values: int) -> Any:
    from runner.integrations.tensorboard import SummaryWriter

    @contextlib.contextmanager
    def run() -> Iterator[Log]:
        log_dir = tempfile.mkdtemp(dir=folder)
        with SummaryWriter(log_dir, recordings=folder / "recordings", monitor_gym=False) as writer:
            yield lambda value: writer.add_scalar("value", value, int(value))

    return contextlib.nullcontext(run)


def _dualtaxi_environment(folder: Path, _values: int) -> Any:
    import gymnasium

    import runner

    @contextlib.contextmanager
    def run() -> Iterator[Log]:
        with runner.record(gymnasium.make("CartPole-v1"), folder) as rec:
            yield lambda value: rec.log("value", value)

    return contextlib.nullcontext(run)


@contextlib.contextmanager
def _mltraq(folder: Path, values: int) -> Iterator[Any]:
    import mltraq

    experiment = mltraq.create_session(f"sqlite:///{folder}/mltraq.db").create_experiment("runs")

    @contextlib.contextmanager
    def run() -> Iterator[Log]:
        with experiment.run() as own:
            if values == 1:
                yield lambda value: setattr(own.fields, "metric", value)
            else:
                own.fields.metric = mltraq.Sequence()
                yield lambda value: own.fields.metric.append(value=value)

    yield run
    experiment.persist()


def _tensorboardx(folder: Path, _values: int) -> Any:
    from tensorboardX import SummaryWriter

    @contextlib.contextmanager
    def run() -> Iterator[Log]:
        with SummaryWriter(tempfile.mkdtemp(dir=folder)) as writer:
            yield lambda value: writer.add_scalar("value", value, int(value))

    return contextlib.nullcontext(run)


def _trackio(_folder: Path, _values: int) -> Any:  # it reads $TRACKIO_DIR
    import trackio

    @contextlib.contextmanager
    def run() -> Iterator[Log]:
        trackio.init(project="benchmark", embed=False)
        yield lambda value: trackio.log({"value": value})
        trackio.finish()

    return contextlib.nullcontext(run)


def _wandb(folder: Path, _values: int) -> Any:
    import wandb

    @contextlib.contextmanager
    def run() -> Iterator[Log]:
        with wandb.init(project="benchmark", dir=folder, mode="offline") as own:
            yield lambda value: own.log({"value": value})

    return contextlib.nullcontext(run)


def _mlflow(folder: Path, _values: int) -> Any:
    import mlflow

    mlflow.set_tracking_uri(folder.as_uri())
    mlflow.set_experiment("benchmark")

    @contextlib.contextmanager
    def run() -> Iterator[Log]:
        with mlflow.start_run():
            yield lambda value: mlflow.log_metric("value", value, step=int(value))

    return contextlib.nullcontext(run)


TRACKERS: dict[str, Track] = {
    "dualtaxi": _dualtaxi,
    "dualtaxi, synced": _dualtaxi_synced,
    "dualtaxi, with an environment": _dualtaxi_environment,
    "MLtraq": _mltraq,
    "tensorboardX": _tensorboardx,
    "trackio": _trackio,
    "wandb, offline": _wandb,
    "MLflow, files": _mlflow,
}


def _main(name: str, runs: int, values: int, repetitions: int, folder: Path) -> None:
    """Print the seconds of each repetition, after one run that is not counted."""
    seconds = []
    for number, count in [(1, 1), *[(runs, values)] * repetitions]:
        own = Path(tempfile.mkdtemp(dir=folder))
        begin = time.perf_counter()
        with TRACKERS[name](own, count) as run:
            for _ in range(number):
                with run() as log:
                    for k in range(count):
                        log(k + 0.5)
        seconds.append(time.perf_counter() - begin)
    print(json.dumps(seconds[1:]))


if __name__ == "__main__":
    _main(sys.argv[1], *map(int, sys.argv[2:5]), Path(sys.argv[5]))
