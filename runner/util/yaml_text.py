"""Plain values as YAML text.

The scalars are those of YAML 1.2's core schema; `runner.config.document` reads the text.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

import yaml

TAG: Final = "tag:yaml.org,2002:"
INT: Final = re.compile(r"^(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$")
SCALARS: Final = (
    ("null", re.compile(r"^(?:~|null|Null|NULL|)$"), ["~", "n", "N", ""]),
    ("bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")),
    ("int", INT, list("-+0123456789")),
    (
        "float",
        re.compile(
            r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
            r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
        ),
        list("-+.0123456789"),
    ),
)
"""Name -> what its text looks like, and the characters that it may begin with."""


class _Dumper(yaml.SafeDumper):
    """Quotes what YAML 1.1 or 1.2 would not read as text."""

    def ignore_aliases(self, data: object) -> bool:  # noqa: ARG002 - PyYAML's signature
        return True


def _represent_text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    return dumper.represent_scalar(TAG + "str", text, style=None if text.isprintable() else '"')


_Dumper.add_representer(str, _represent_text)
for _name, _pattern, _first in SCALARS:
    _Dumper.add_implicit_resolver(TAG + _name, _pattern, _first)


def write_yaml(value: Mapping[str, object], is_compact: bool = False) -> str:
    """Return `value` as YAML, from which `read_yaml` returns an equal value; compact with `{a: 1, b: 2}`."""
    style = None if is_compact else False
    text: str = yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, default_flow_style=style, allow_unicode=True, width=110
    )
    return text
