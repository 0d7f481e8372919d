"""Measured figures with their targets, and the table that lists them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from benchmarks.processes import Process


@dataclass(frozen=True)
class Figure:
    """A measured figure, the target it must reach (`at_least`) and the one it should reach (`aim`)."""

    what: str
    value: float
    unit: str
    at_least: float | None = None
    aim: float | None = None
    higher_is_better: bool = True
    spread: tuple[float, float] | None = None
    """Lowest and highest measured value."""
    detail: str = ""
    """How it was measured, and the absolute figures behind a ratio."""

    @property
    def standing(self) -> str:
        """The target reached: `aim`, `at least` or `short` for neither; empty without targets."""
        for name, target in (("aim", self.aim), ("at least", self.at_least)):
            if target is not None and (self.value >= target) == self.higher_is_better:
                return name
        return "short" if self.at_least is not None else ""


def figure(
    what: str,
    values: Sequence[float],
    unit: str,
    targets: tuple[float, float] | None = None,
    *,
    higher_is_better: bool = True,
    detail: str = "",
) -> Figure:
    """Return the median of repeated measurements as a figure; `targets` are (at least, aim)."""
    at_least, aim = targets or (None, None)
    spread = (min(values), max(values)) if len(values) > 1 else None
    return Figure(what, statistics.median(values), unit, at_least, aim, higher_is_better, spread, detail)


def command_seconds(what: str, processes: Sequence[Process], targets: tuple[float, float]) -> Figure:
    """Return the elapsed time of repeated processes, with their processor time as detail."""
    cpu = statistics.median(process.cpu_seconds for process in processes)
    times = [process.seconds for process in processes]
    detail = f"{cpu:.2f} s of processor time in all threads"
    return figure(what, times, "s", targets, higher_is_better=False, detail=detail)


def peak_memory(what: str, processes: Sequence[Process], targets: tuple[float, float]) -> Figure:
    """Return the highest peak memory of some processes, in MB."""
    peak = max(process.peak_megabytes for process in processes)
    return figure(what, [peak], "MB", targets, higher_is_better=False)


def processor_seconds(work: Callable[[], object]) -> tuple[float, float]:
    """Return the processor time of a call, of this thread and of the process."""
    thread, process = time.thread_time(), time.process_time()
    work()
    return time.thread_time() - thread, time.process_time() - process


def seconds(work: Callable[[], object]) -> float:
    """Return the elapsed time of a call."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


_WIDTHS = (44, 16, 21, 10, 8)


def heading() -> str:
    """Return the first lines of the table."""
    return (
        _row("median of repetitions", "measured", "lowest to highest", "at least", "aim") + "\n" + "-" * 112
    )


def row(figure: Figure) -> str:
    """Return the lines of a figure in the table."""
    sign = "≥ " if figure.higher_is_better else "≤ "
    spread = " to ".join(_number(value) for value in figure.spread) if figure.spread else ""
    targets = ("" if target is None else sign + _number(target) for target in (figure.at_least, figure.aim))
    reached = {"aim": "reached", "at least": "below the aim", "short": "SHORT"}.get(figure.standing, "")
    line = _row(figure.what, f"{_number(figure.value)} {figure.unit}", spread, *targets) + "  " + reached
    return "\n".join([line.rstrip(), *(f"    {text}" for text in figure.detail.splitlines())])


def _row(what: str, *cells: str) -> str:
    return what.ljust(_WIDTHS[0]) + "".join(
        cell.rjust(width) for cell, width in zip(cells, _WIDTHS[1:], strict=True)
    )


def _number(value: float) -> str:
    """Return a number with three digits that count."""
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.3g}"
