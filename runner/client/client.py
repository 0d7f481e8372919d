"""A client of the service: submits jobs, pushes and pulls runs, and continues when a connection breaks.

    from runner.client.client import Client

    with Client("http://localhost:8000") as client:
        client.push(runner.find_run("@latest", Path("recordings")))

Bytes that were sent before a connection broke are not sent again; the same run pushed twice is stored once.
"""

from __future__ import annotations

from runner.client import jobs, transfer
from runner.client.connection import Connection
from runner.client.jobs import JobsPage, JobStatus


class Client(Connection):
    """A connection to a server, with everything that can be requested of it."""

    watch = jobs.watch
    pull = transfer.pull
    push = transfer.push

    def submit(self, text: str, source: str = "job.yaml", workers: int | None = None) -> JobStatus:
        """Submit the text of a configuration or a sweep; `source` is the file's name, for messages.

        A sweep holds that many `workers` of the server while it is running, all of them by default.

        Raises:
            ServerError: it was refused, each mistake with its line; or the server is unavailable.
        """
        params = {"source": source} | ({} if workers is None else {"workers": workers})
        options = {"params": params, "content": text.encode()}
        return self.request_record(JobStatus, "POST", "/jobs", **options)

    def job(self, number: int) -> JobStatus:
        """Return a job; errors as for `request`."""
        return self.request_record(JobStatus, "GET", f"/jobs/{number}")

    def jobs(self, limit: int = 50, offset: int = 0) -> list[JobStatus]:
        """Return jobs, the newest first; errors as for `request`."""
        return self.request_record(JobsPage, "GET", "/jobs", params={"limit": limit, "offset": offset}).jobs

    def cancel(self, number: int) -> JobStatus:
        """Cancel a job; what it has recorded stays. Errors as for `request`."""
        return self.request_record(JobStatus, "POST", f"/jobs/{number}/cancel")

    def resume(self, number: int, accept_changes: bool = False) -> JobStatus:
        """Resume a failed or cancelled job; errors as for `request`."""
        options = {"params": {"accept_changes": accept_changes}}
        return self.request_record(JobStatus, "POST", f"/jobs/{number}/resume", **options)
