"""A client of the service: submits jobs, pushes and pulls runs, and continues when a connection breaks.

    from runner.client.client import Client

    with Client("http://localhost:8000") as client:
        client.push(runner.find_run("@latest", Path("recordings")))

Bytes that were sent before a connection broke are not sent again; the same run pushed twice is stored once.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from runner.client.connection import Connection, Report
from runner.client.jobs import JobEvent, RemoteJob, watch
from runner.client.pull import pull
from runner.client.uploads import UploadStatus, push

if TYPE_CHECKING:
    from runner.runs.importing import Imported
    from runner.runs.run import Run


class Client(Connection):
    """A connection to a server, with everything that can be requested of it."""

    # --- jobs -----------------------------------------------------------------------------------------

    def submit(self, text: str, source: str = "job.yaml", workers: int | None = None) -> RemoteJob:
        """Submit the text of a configuration or a sweep; `source` is the file's name, for messages.

        A sweep holds that many `workers` of the server while it is running, all of them by default.

        Raises:
            ServerError: it was refused, each mistake with its line; or the server is unavailable.
        """
        params = {"source": source} | ({} if workers is None else {"workers": workers})
        options = {"params": params, "content": text.encode()}
        return RemoteJob.from_json(self.request_object("POST", "/jobs", **options))

    def job(self, number: int) -> RemoteJob:
        """Return a job; errors as for `request`."""
        return RemoteJob.from_json(self.request_object("GET", f"/jobs/{number}"))

    def jobs(self, limit: int = 50, offset: int = 0) -> list[RemoteJob]:
        """Return jobs, the newest first; errors as for `request`."""
        page = self.request_object("GET", "/jobs", params={"limit": limit, "offset": offset})
        return [RemoteJob.from_json(job) for job in page["jobs"]]

    def watch(self, number: int) -> Iterator[JobEvent]:
        """Yield the events of a job until it is over; see `runner.client.jobs.watch`."""
        return watch(self, number)

    def cancel(self, number: int) -> RemoteJob:
        """Cancel a job; what it has recorded stays. Errors as for `request`."""
        return RemoteJob.from_json(self.request_object("POST", f"/jobs/{number}/cancel"))

    def resume(self, number: int, accept_changes: bool = False) -> RemoteJob:
        """Resume a failed or cancelled job; errors as for `request`."""
        options = {"params": {"accept_changes": accept_changes}}
        return RemoteJob.from_json(self.request_object("POST", f"/jobs/{number}/resume", **options))

    # --- runs -----------------------------------------------------------------------------------------

    def pull(self, name: str, recordings: Path, report: Report = lambda *_: None) -> Imported:
        """Download a run into a recordings folder; see `runner.client.pull.pull`."""
        return pull(self, name, recordings, report)

    def push(self, run: Run, report: Report = lambda *_: None, begun: str = "") -> UploadStatus:
        """Upload a run with its checkpoints; see `runner.client.uploads.push`."""
        return push(self, run, report, begun)
