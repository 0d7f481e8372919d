"""A job on a Ray cluster: submitted by Ray's job API as a command, which does it from its folder."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shlex
import time
from typing import Any, Final

from runner.client.jobs import JobEvent, LogEvent, StateEvent
from runner.errors import RunnerError
from runner.service.jobs.channel import JobChannel, JobSpec
from runner.util.extras import require
from runner.util.processes import OWN_ONLY

POLL_SECONDS: Final = 0.5
CLOSE_SECONDS: Final = 10
"""How long the command may take to close its recording before Ray kills it."""
START_SECONDS: Final = 60
"""How long to wait for a cluster that has just started, or whose machines are all busy, to take a job."""
LOG_SECONDS: Final = 5.0
"""How long to wait for the rest of the log of a command that has ended."""
COMMAND: Final = "python -P -m runner run --job"
"""The command without the folder of its job; `-P` imports nothing from the current folder."""


def require_job_api() -> Any:
    """Return the module of Ray's job API, with all that it needs."""
    return require("ray.job_submission", "aiohttp", extra="ray", purpose="`serve --ray`")


def do_on_cluster(spec: JobSpec, address: str, channel: JobChannel) -> StateEvent | None:
    """Have a cluster do what is left of a job, and forward its events; return its outcome.

    None if the command died, perhaps with its machine. What a killed server left on the cluster is stopped.
    """
    folder = os.fspath(spec.folder)
    try:
        client = require_job_api().JobSubmissionClient(address)
        for job in client.list_jobs():
            if (job.metadata or {}).get("folder") == folder and not job.status.is_terminal():
                client.stop_job(job.submission_id)
        submission = _submitted(
            client,
            channel,
            entrypoint=f"{COMMAND} {shlex.quote(folder)}",
            entrypoint_num_cpus=1 if spec.job.run_ids else 0,
            runtime_env={"env_vars": {OWN_ONLY: "1", "RAY_JOB_STOP_WAIT_TIME_S": str(CLOSE_SECONDS)}},
            metadata={"folder": folder},
        )
        return asyncio.run(_follow(client, submission, channel))
    except (OSError, RuntimeError, RunnerError) as error:
        return StateEvent("failed", f"--ray: the cluster at {address} does not do this job: {error}")


def _submitted(client: Any, channel: JobChannel, **job: object) -> str:
    """Submit a job and return its number; where Ray asks for another try later, try for a minute."""
    end = time.monotonic() + START_SECONDS
    while True:
        try:
            return str(client.submit_job(**job))
        except RuntimeError as error:
            if "try again later" not in str(error) or channel.stop() or time.monotonic() > end:
                raise
        time.sleep(POLL_SECONDS)


async def _follow(client: Any, submission: str, channel: JobChannel) -> StateEvent | None:
    """Forward the events of a command until it has ended; return its outcome."""
    log = asyncio.create_task(_forward(client, submission, channel))
    while not client.get_job_status(submission).is_terminal():
        if channel.stop():
            client.stop_job(submission)
        await asyncio.sleep(POLL_SECONDS)
    with contextlib.suppress(OSError, RuntimeError):  # the machine with the log is gone
        async with asyncio.timeout(LOG_SECONDS):
            if (outcome := await log) is not None:
                return outcome
    if channel.stop():
        return StateEvent("interrupted")
    channel.send(LogEvent(f"Ray: {client.get_job_info(submission).message}"))
    return None


async def _forward(client: Any, submission: str, channel: JobChannel) -> StateEvent | None:
    """Send the events in the log of a command, whose other lines are what libraries print."""
    rest, outcome = "", None
    async for text in client.tail_job_logs(submission):
        *lines, rest = (rest + text).split("\n")
        for line in lines:
            with contextlib.suppress(RunnerError):
                data = JobEvent.from_line(line).data
                if isinstance(data, StateEvent):
                    outcome = data
                else:
                    channel.send(data)
    return outcome
