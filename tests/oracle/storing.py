"""Keeps logical contents in two files, and compares them.

`content.json` names the columns of each table of each run, with type, number of rows, checksum and first row;
`content.xz` has all values, one column after the other.
"""

from __future__ import annotations

import json
import lzma
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tests.oracle.reading import Column, Content

HERE = Path(__file__).parent
INDEX, VALUES = HERE / "content.json", HERE / "content.xz"


def write(contents: Mapping[str, Content]) -> None:
    """Keep the contents of runs, by name."""
    index: dict[str, Any] = {}
    values = bytearray()
    for run, content in contents.items():
        index[run] = {}
        for table, columns in content.items():
            index[run][table] = {}
            for name, column in columns.items():
                data = _data(column)
                values += data
                facts = [_type(column), list(column.shape), len(data), f"{zlib.crc32(data):08x}"]
                index[run][table][name] = [
                    *facts,
                    column[0].tolist() if _type(column) != "text" else column[0],
                ]
    lines = ["{"]
    for i, (run, tables) in enumerate(index.items()):
        lines.append(f' "{run}": {{')
        for j, (table, columns) in enumerate(tables.items()):
            lines.append(f'  "{table}": {{')
            rows = [f"   {json.dumps(name)}: {json.dumps(facts)}" for name, facts in columns.items()]
            lines.append(",\n".join(rows))
            lines.append("  }" + ("," if j < len(tables) - 1 else ""))
        lines.append(" }" + ("," if i < len(index) - 1 else ""))
    INDEX.write_text("\n".join([*lines, "}"]) + "\n", encoding="utf-8")
    VALUES.write_bytes(lzma.compress(bytes(values), preset=9 | lzma.PRESET_EXTREME))


def read() -> dict[str, Content]:
    """Return the contents that are kept, by the name of the run."""
    values = memoryview(lzma.decompress(VALUES.read_bytes()))
    contents: dict[str, Content] = {}
    at = 0
    for run, tables in json.loads(INDEX.read_text(encoding="utf-8")).items():
        contents[run] = {}
        for table, columns in tables.items():
            contents[run][table] = {}
            for name, (kind, shape, size, checksum, _) in columns.items():
                data, at = bytes(values[at : at + size]), at + size
                assert f"{zlib.crc32(data):08x}" == checksum, f"{run}: {table}.{name} is damaged"
                is_text = kind == "text"
                column = (
                    np.array([*json.loads(data), None], object)[:-1] if is_text else np.frombuffer(data, kind)
                )
                contents[run][table][name] = column if is_text else column.reshape(shape)
    return contents


def differences(run: str, expected: Content, found: Content) -> Iterator[str]:
    """Yield what differs in the content of a run: run, table, column, row and both values."""
    for table in sorted(expected.keys() | found.keys()):
        if table not in found or table not in expected:
            yield f"{run}: {table}: {'missing' if table in expected else 'not expected'}"
            continue
        for name in sorted(expected[table].keys() | found[table].keys()):
            where = f"{run}: {table}.{name}"
            if name not in found[table] or name not in expected[table]:
                yield f"{where}: {'missing' if name in expected[table] else 'not expected'}"
                continue
            old, new = expected[table][name], found[table][name]
            if (_type(old), old.shape) != (_type(new), new.shape):
                yield f"{where}: found {_type(new)}{list(new.shape)}, expected {_type(old)}{list(old.shape)}"
                old, new = old[: len(new)], new[: len(old)]
            if _data(old) != _data(new):
                rows = [k for k in range(len(old)) if _data(old[k : k + 1]) != _data(new[k : k + 1])]
                more = f", and {len(rows) - 1} more rows" if rows[1:] else ""
                yield f"{where}, row {rows[0]}: found {new[rows[0]]}, expected {old[rows[0]]}{more}"


def _type(column: Column) -> str:
    return "text" if column.dtype == object else column.dtype.str


def _data(column: Column) -> bytes:
    return json.dumps(column.tolist()).encode() if column.dtype == object else column.tobytes()
