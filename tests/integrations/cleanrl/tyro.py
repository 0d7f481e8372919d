"""Stands in for tyro, with which these scripts parse their command line: `--name value` of simple types."""

import sys
from ast import literal_eval


def cli(settings):
    names, values = sys.argv[1::2], sys.argv[2::2]
    given = {}
    for name, value in zip(names, values, strict=True):
        try:
            given[name.removeprefix("--").replace("-", "_")] = literal_eval(value)
        except (ValueError, SyntaxError):
            given[name.removeprefix("--").replace("-", "_")] = value
    return settings(**given)
