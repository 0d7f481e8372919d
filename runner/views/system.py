"""`system`: how fast a run went, and what it used of its machine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from runner.analysis.sections import Answer, Section
from runner.views.view import View

if TYPE_CHECKING:
    from runner.recording.clock import Clock
    from runner.recording.host import HostMetrics
    from runner.recording.reader import Recording
    from runner.util.values import Json


@dataclass(frozen=True)
class MachineUse(Answer):
    """The clock of a run, and samples of what it used of its machine; None where they were not recorded."""

    clock: Clock | None
    host: HostMetrics | None

    def as_json(self) -> Json:
        """Return seconds, steps a second, and the largest use of memory in bytes, if known."""
        return {
            "seconds": self.clock and self.clock.duration,
            "sessions": self.clock and len(self.clock.earlier),
            "steps_a_second": self.clock and self.clock.steps_a_second,
            **({} if self.host is None else self.host.largest),
        }

    def sections(self) -> list[Section]:
        """Return facts, and charts over time."""
        from runner.export.plots.machine import machine_facts, machine_plots

        if self.clock is None:
            return [Section("Time and machine", ["Its recording has no clock."])]
        text = "No use of the machine was recorded: it is measured once a second, unless `system` is off."
        return [
            Section("Time and machine", facts=machine_facts(self.clock, self.host)),
            Section(
                "Over time", [text] if self.host is None else [], figures=machine_plots(self.clock, self.host)
            ),
        ]


def system(recording: Recording) -> MachineUse:
    """Show how fast RUN went, and what it used of its machine: memory, GPU memory and disk.

    The page of the run has charts of processor, memory, GPUs, disk and network over time.

    Examples:
      dualtaxi system @latest
      dualtaxi system cartpole --json
    """
    from runner.recording.clock import read_clock
    from runner.recording.host import read_host

    clock = read_clock(recording)
    return MachineUse(clock, read_host(recording, clock))


VIEW: Final = View("system", "System", system, has_default=True, is_live=True)
