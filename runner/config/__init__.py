"""Configuration: a YAML file, or Python values, to one frozen and validated `ExperimentConfig`.

    config = load("quick", ["episodes=50", "evaluation.trials=10"])

All problems are reported in one `ConfigError`, a line for each.
"""

from runner.config.loading import from_mapping, from_text, load
from runner.config.model import ExperimentConfig, ExperimentFile
from runner.config.schedules import Exponential, Linear, Piecewise, Schedule
from runner.config.schema import json_schema
from runner.config.sections import (
    Environment,
    Evaluation,
    Log,
    Quirks,
    RandomTable,
    Recording,
    RunTable,
    Snapshots,
    UniformRange,
)
from runner.errors import ConfigError

__all__ = [
    "ConfigError",
    "Environment",
    "Evaluation",
    "ExperimentConfig",
    "ExperimentFile",
    "Exponential",
    "Linear",
    "Log",
    "Piecewise",
    "Quirks",
    "RandomTable",
    "Recording",
    "RunTable",
    "Schedule",
    "Snapshots",
    "UniformRange",
    "from_mapping",
    "from_text",
    "json_schema",
    "load",
]
