"""Recording any training loop over any environment: wrappers that watch, and change nothing."""
