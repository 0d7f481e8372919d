"""Questions about how the tutorial's cooperative run learned: time of whole commands, and memory."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.figures import Figure, command_seconds, peak_memory
from benchmarks.processes import dualtaxi, run, run_command
from runner.config import load

CONFIG = "tutorial_cooperative"
STATE = 'q[300, "north + east"] > q[300, "west + east"]'
NEVER = "max(q[300]) > 1e6"
PATH = "greedy_success[300]"
MEMORY = (400, 300)
VALUE = ("--state", "300", "--action", "north+south")


def measure(quick: bool) -> list[Figure]:
    """Return times of commands, with compiled code in its cache, and their peak memory."""
    repetitions, times = (3, 2) if quick else (7, 10)
    with tempfile.TemporaryDirectory() as folder:
        run(run_command(CONFIG, folder))
        figures = [*training(folder, repetitions), *what_if(folder, repetitions)]
        figures += [*when(folder, repetitions), *why(folder, repetitions)]
    with tempfile.TemporaryDirectory() as folder:
        run(run_command(CONFIG, folder, f"episodes={50_000 * times}"))
        longer = [dualtaxi(folder, "when", "@latest", text, "--all") for text in (STATE, PATH, "reward > 0")]
        at = f"{50_000 * times - 1}:0"
        last = dualtaxi(folder, "branch", "@latest", "--at", at, "--action", "all")
        whole = dualtaxi(folder, "why", "@latest", *VALUE)
        trained = dualtaxi(folder, "branch", "@latest", "--at", at, "--set", "epsilon=0.3")
    figures += explain(1 if quick else 3)
    return [
        *figures,
        peak_memory(f"  why, for a run {times} times as long", [whole], MEMORY),
        peak_memory(f"  when, for a run {times} times as long", longer, MEMORY),
        peak_memory(f"  branch, all actions, for a run {times} times as long", [last], MEMORY),
        peak_memory(f"  training branch, for a run {times} times as long", [trained], MEMORY),
    ]


def training(folder: str, repetitions: int) -> list[Figure]:
    """Return the figures of a branch of training that ends soon after its step.

    The command trains and records all steps before it, so that its whole time is that until it goes on.
    """
    parent = next(Path(folder).glob("*/recording.mcap")).parent
    words = ("branch", str(parent), "--at", "step:4000000", "--set", "epsilon=0.3")
    end = ("--episodes", "46258")  # the step is in episode 46,257
    with tempfile.TemporaryDirectory() as other:
        dualtaxi(other, *words, *end)  # compiles
        done = [dualtaxi(other, *words, *end) for _ in range(repetitions)]
    what = "training branch at step 4 M, until it goes on"
    return [command_seconds(what, done, (1, 0.3)), peak_memory("  peak memory", done, MEMORY)]


def what_if(folder: str, repetitions: int) -> list[Figure]:
    """Return the figures of `dualtaxi branch --action all`."""
    places = {
        "branch, all actions, of a trial": "eval:50000:3:5",
        "branch, all actions, of a training episode": "49000:3",
    }
    figures, processes = [], []
    for what, at in places.items():
        words = ("branch", "@latest", "--at", at, "--action", "all")
        dualtaxi(folder, *words)  # compiles
        done = [dualtaxi(folder, *words) for _ in range(repetitions)]
        figures.append(command_seconds(what, done, (1, 0.3)))
        processes += done
    return [*figures, peak_memory("  peak memory", processes, MEMORY)]


def when(folder: str, repetitions: int) -> list[Figure]:
    """Return the figures of `dualtaxi when` for one state."""
    dualtaxi(folder, "when", "@latest", PATH)  # compiles
    questions = {
        "when, first time": ((1, 0.3), [STATE]),
        "when, searched to the end, never found": ((2, 0.5), [NEVER]),
        "when, every time": ((2, 0.5), [STATE, "--all"]),
        "when, every time, of a greedy path": ((2, 0.5), [PATH, "--all"]),
    }
    figures, processes = [], []
    for what, (targets, words) in questions.items():
        done = [dualtaxi(folder, "when", "@latest", *words) for _ in range(repetitions)]
        figures.append(command_seconds(what, done, targets))
        processes += done
    return [*figures, peak_memory("  peak memory", processes, MEMORY)]


def explain(repetitions: int) -> list[Figure]:
    """Return the figures of `dualtaxi explain` for four settings and twenty seeds, 5,000 episodes each."""
    words = ["explain", CONFIG, "other.yaml", "--at", "5000", "--seeds", "20"]
    processes = []
    for _ in range(repetitions + 1):  # the first one compiles
        with tempfile.TemporaryDirectory() as folder:
            other = load("tutorial_text_cooperative", ["step_size=0.3", "discount=0.9"])
            words[2] = str(Path(folder, "other.yaml"))
            Path(words[2]).write_text(other.to_yaml(), encoding="utf-8")
            processes.append(dualtaxi(folder, *words))
    figures = [command_seconds("explain, 4 settings, 20 seeds, 5,000 episodes", processes[1:], (60, 25))]
    return [*figures, peak_memory("  peak memory of its main process", processes, MEMORY)]


def why(folder: str, repetitions: int) -> list[Figure]:
    """Return the figures of `dualtaxi why` for a value at the end."""
    dualtaxi(folder, "why", "@latest", *VALUE)  # compiles
    done = [dualtaxi(folder, "why", "@latest", *VALUE) for _ in range(repetitions)]
    return [
        command_seconds("why, a value at the end", done, (2, 0.5)),
        peak_memory("  peak memory", done, MEMORY),
    ]
