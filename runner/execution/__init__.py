"""Training a job: recording it, resuming it, verifying it and recording it again."""
