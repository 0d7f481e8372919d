"""A stand-in for `dualtaxi run` while there is none."""

from __future__ import annotations

import argparse
from pathlib import Path

from runner.config import load
from runner.execution import run_job
from runner.job import jobs_of
from runner.runs import create_run

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("config")
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--set", action="append", default=[])
    options = parser.parse_args()
    config = load(options.config, options.set)
    for job in jobs_of(config):
        run_job(job, create_run(options.recordings, config, job.seed))
