"""What every package may use: values, names, files, formatting, optional packages, child processes.

This module imports nothing, so that the version is known where a package that is heavy is not loaded.
"""

__version__ = "0.1.0"
"""The version of this package."""
