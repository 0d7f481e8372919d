"""`system`: how fast a run went, and what it used of its machine."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from runner.analysis.sections import Section
from runner.views.view import ReadyAnswer, View

if TYPE_CHECKING:
    from runner.recording.machine import Clock, HostMetrics
    from runner.recording.reader import Recording


def system(recording: Recording) -> ReadyAnswer:
    """Show how fast RUN went, and what it used of its machine: memory, GPU memory and disk.

    The page of the run has charts of processor, memory, GPUs, disk and network over time.

    Examples:
      dualtaxi system @latest
      dualtaxi system cartpole --json
    """
    from runner.recording.machine import read_clock, read_host

    clock = read_clock(recording)
    host = read_host(recording, clock)
    data = {
        "seconds": clock and clock.duration,
        "sessions": clock and len(clock.earlier),
        "steps_a_second": clock and clock.steps_a_second,
        **({} if host is None else host.largest),
    }
    return ReadyAnswer(data, _text(clock, host))


def _text(clock: Clock | None, host: HostMetrics | None) -> Iterator[Section]:
    """Yield facts, and charts over time."""
    from runner.export.plots.training import machine_facts, machine_plots

    if clock is None:
        yield Section("Time and machine", ["Its recording has no clock."])
        return
    yield Section("Time and machine", facts=machine_facts(clock, host))
    text = "No use of the machine was recorded: it is measured once a second, unless `system` is off."
    yield Section("Over time", [text] if host is None else [], figures=machine_plots(clock, host))


VIEW: Final = View("system", "System", system, has_default=True, is_live=True)
