"""Train tabular agents from a YAML file and record every step; replay, compare and archive the runs."""

from __future__ import annotations

__version__ = "0.1.0"
