"""The questions in docs/find.md have the answers that stand there."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner

import runner
from runner.cli import cli

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "find.md").read_text(encoding="utf-8")
QUESTIONS = re.findall(r"^\| ([^|]+\?) \| `(.+)` \| (.+) \|$", TEXT, re.MULTILINE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    runner.run(ROOT / "configs" / "quick.yaml", recordings=folder)
    return folder


def test_there_are_twenty():
    assert len(QUESTIONS) == 20


@pytest.mark.parametrize(("question", "words", "answer"), QUESTIONS)
def test_a_question_has_its_answer(folder, question, words, answer):
    line = ["find", *shlex.split(words), "--recordings", str(folder), "--json"]
    result = CliRunner().invoke(cli, line)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    first = f", first {found['hits'][0]['at']}" if found["hits"] else ""
    assert f"{found['count']:,}{first}" == answer
