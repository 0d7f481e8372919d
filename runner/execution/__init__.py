"""Run a job: record, resume, verify and rerecord it."""
