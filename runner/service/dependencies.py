"""What routes ask for: settings, the catalogue, kept answers, the run that is meant."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from fastapi import Depends, Path, Request

from runner.errors import RecordingError
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run
from runner.service.catalogue import Catalogue
from runner.service.jobs.pool import JobPool
from runner.service.processes import ProcessPool
from runner.service.response_cache import ResponseCache
from runner.service.settings import Settings


def settings_of(request: Request) -> Settings:
    """Return the settings of the service."""
    found: Settings = request.app.state.settings
    return found


def catalogue_of(request: Request) -> Catalogue:
    """Return the catalogue."""
    found: Catalogue = request.app.state.catalogue
    return found


def cache_of(request: Request) -> ResponseCache:
    """Return the answers that are kept."""
    found: ResponseCache = request.app.state.cache
    return found


def jobs_of(request: Request) -> JobPool:
    """Return the jobs, done beside the service."""
    found: JobPool = request.app.state.jobs
    return found


def processes_of(request: Request) -> ProcessPool:
    """Return what does work in processes of its own."""
    found: ProcessPool = request.app.state.processes
    return found


def sweep_processes_of(request: Request) -> ProcessPool:
    """Return the child processes that compute what pages show of sweeps."""
    found: ProcessPool = request.app.state.sweep_processes
    return found


SettingsOf = Annotated[Settings, Depends(settings_of)]
CatalogueOf = Annotated[Catalogue, Depends(catalogue_of)]
ProcessesOf = Annotated[ProcessPool, Depends(processes_of)]
SweepProcesses = Annotated[ProcessPool, Depends(sweep_processes_of)]
CacheOf = Annotated[ResponseCache, Depends(cache_of)]
JobsOf = Annotated[JobPool, Depends(jobs_of)]
RunName = Annotated[
    str,
    Path(
        max_length=200,
        description="A run: its id, the beginning of it, its name, `@latest` or `NAME@latest`.",
        examples=["@latest"],
    ),
]


def found_run(run: RunName, catalogue: CatalogueOf) -> Run:
    """Return the run that the path names.

    Raises:
        RunNotFound: no run matches the name, or several do.
    """
    return catalogue.find(run)


FoundRun = Annotated[Run, Depends(found_run)]


def recorded_run(run: FoundRun) -> Run:
    """Return the run that the path names, with its recording at hand: restored if it is archived.

    Raises:
        RecordingError: it has no recording, or its archive is damaged or missing.
    """
    from runner.archive.places import at_hand

    found = at_hand(run)
    if not found.recording.is_file():
        raise RecordingError(f"run {run.run_id} has no recording: it ended before there was one.")
    return found


RecordedRun = Annotated[Run, Depends(recorded_run)]


def opened_recording(run: RecordedRun) -> Iterator[Recording]:
    """Give the recording of the run that the path names, opened.

    Raises:
        RecordingError: it cannot be read.
    """
    with open_recording(run.recording) as recording:
        yield recording


OpenRecording = Annotated[Recording, Depends(opened_recording)]


def recording_state(run: Run) -> tuple[str, int, int]:
    """Return what tells one state of a run's recording from another: its path, size and time."""
    facts = run.recording.stat()
    return str(run.recording), facts.st_size, facts.st_mtime_ns


def timed_recording_state(run: Run) -> tuple[str, int, int, str]:
    """Return the same with how long the run took, which only `run.json` says, at times later."""
    return *recording_state(run), str(run.summary.seconds)
