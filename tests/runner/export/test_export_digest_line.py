"""The line of a report about a run without a content digest."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

from runner.cli import cli
from runner.recording.run_file import owner
from tests.runner.recording.making import LAKE, make_run


@pytest.mark.parametrize("status", ["running", "interrupted"])
def test_a_report_explains_a_missing_digest(status, tmp_path):
    run = make_run(tmp_path / "recordings", LAKE, episodes=200)
    data = run.recording.read_bytes()
    run.recording.write_bytes(data[: len(data) * 2 // 3])
    run.update(status=status, owner=owner(), summary={})
    page = tmp_path / "report.html"
    result = CliRunner().invoke(cli, ["report", str(run.folder), "-o", str(page)])
    assert result.exit_code == 0, result.output
    assert "written when a run ends properly" in page.read_text()
