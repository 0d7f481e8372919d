"""Configuration: a YAML file, or Python values, to one frozen and validated `ExperimentConfig`.

    config = load("quick", ["episodes=50", "evaluation.trials=10"])

All problems are reported in one `ConfigError`, a line for each.
"""

from runner.config.loading import from_mapping, from_text, load
from runner.config.model import ExperimentConfig, ExperimentFile
from runner.config.schema import json_schema
from runner.errors import ConfigError

__all__ = [
    "ConfigError",
    "ExperimentConfig",
    "ExperimentFile",
    "from_mapping",
    "from_text",
    "json_schema",
    "load",
]
