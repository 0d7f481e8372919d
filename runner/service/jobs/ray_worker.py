"""The run of a seed, done by an actor of Ray."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from runner.errors import RunnerError
from runner.service.jobs.seeds import do_seed
from runner.service.jobs.spec import TELL_SECONDS, Heard, Order

if TYPE_CHECKING:
    from runner.config import ExperimentConfig


def do_seed_far(order: Order, line: Heard, config: ExperimentConfig, seed: int, number: int) -> str:
    """Have an actor of Ray do what `do_seed` does, and pass on what it tells.

    Raises:
        RunnerError: the cluster cannot be reached, the run fails, or the actor dies.
    """
    from runner.sweep.cluster import connect

    ray = connect(order.ray)
    try:
        actor = ray.remote(Far).options(num_cpus=1, max_concurrency=3, max_restarts=0).remote()
        result = actor.do.remote(order, config.to_mapping(), seed, number)
        is_over = False
        while not is_over:
            is_over = bool(ray.wait([result], timeout=TELL_SECONDS)[0])
            for kind, data in ray.get(actor.told.remote()):
                line.tell(kind, data)
            if line.stop():
                actor.end.remote()
        status, wrong = ray.get(result)
    except ray.exceptions.RayError as error:
        raise RunnerError(f"--ray: the actor that did seed {seed} is gone: {error}") from error
    finally:
        ray.shutdown()
    if wrong:
        raise RunnerError(wrong)
    return str(status)


class Far:
    """Does the run of a seed elsewhere, keeps what it tells until that is asked for; an actor of Ray."""

    def __init__(self) -> None:
        self._stopping = threading.Event()
        self._told: list[tuple[str, Any]] = []
        self._lock = threading.Lock()

    def do(self, order: Order, values: dict[str, Any], seed: int, number: int) -> tuple[str, str]:
        """Do it; return the run's status, and what went wrong."""
        from runner.config import from_mapping

        try:
            return do_seed(order, self, from_mapping(values), seed, number), ""
        except RunnerError as error:
            return "failed", str(error)

    def tell(self, kind: str, data: Any) -> None:
        """Keep what the run tells."""
        with self._lock:
            self._told.append((kind, data))

    def told(self) -> list[tuple[str, Any]]:
        """Return what it has told since this was last asked."""
        with self._lock:
            told, self._told = self._told, []
        return told

    def stop(self) -> bool:
        """Return whether the run is to stop."""
        return self._stopping.is_set()

    def end(self) -> None:
        """Have the run stop."""
        self._stopping.set()
