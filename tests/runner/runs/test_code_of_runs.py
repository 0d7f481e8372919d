"""The recorded code of whole runs: compared, shown, restored, carried along, and read from hostile files."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zstandard
from click.testing import CliRunner

from runner.archive.reading import restore
from runner.cli import cli
from runner.config import from_mapping
from runner.config.model import Job
from runner.errors import RecordingError
from runner.execution.rerecord import rerecord
from runner.execution.resume import resume
from runner.execution.session import run_job
from runner.execution.verify import verify
from runner.export.mcap import export_mcap
from runner.recording.code import CODE_ATTACHMENT, CODE_RECORD, Code, parse_code
from runner.recording.reader import open_recording
from runner.recording.repair import repair
from runner.recording.writer import RecordingFile
from runner.runs import code as code_module
from runner.runs.resolve import find_run
from runner.runs.run import create_run, list_runs
from tests.runner.archive.whole import archived
from tests.runner.recording.making import LAKE, stopping_after
from tests.runner.runs.repositories import git, new_project

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")

LOOP = """
import gymnasium, runner
with runner.record(gymnasium.make("CartPole-v1"), "recordings", name="pole") as env:
    env.reset(seed=0)
    for _ in range({steps}):
        if env.step(1)[2]:
            env.reset()
"""


@pytest.fixture(autouse=True)
def _recorded_code(monkeypatch):
    monkeypatch.delenv("DUALTAXI_CODE", raising=False)


@pytest.fixture
def project(tmp_path, monkeypatch):
    folder = new_project(tmp_path / "project")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(code_module, "_recent", {})
    return folder


def job_in(folder: Path, **parts: object):
    config = from_mapping({**LAKE, **parts})
    run = create_run(folder / "recordings", config, 0)
    return run_job(Job(config, 0), run)


def loop_in(folder: Path, steps: int) -> str:
    """Run a script of the project; return the id of its run."""
    (folder / "train.py").write_text(LOOP.format(steps=steps))
    variables = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    before = {run.run_id for run in list_runs(folder / "recordings")}
    subprocess.run([sys.executable, "train.py"], cwd=folder, env=variables, check=True, capture_output=True)
    (new,) = {run.run_id for run in list_runs(folder / "recordings")} - before
    return new


def dualtaxi(folder: Path, *words: str) -> str:
    done = CliRunner().invoke(cli, [*words, "--recordings", str(folder / "recordings")])
    assert done.exit_code in (0, 1), done.output
    return done.stdout


def code_of(path: Path) -> tuple[dict[str, str], Code]:
    with open_recording(path) as recording:
        assert "provenance" in recording.file.metadata_names
        return recording.file.metadata(CODE_RECORD), recording.code


# --- jobs --------------------------------------------------------------------------------------------------


def test_a_job_records_the_repository_of_the_current_folder(project):
    (project / "train.py").write_text("rate = 2\nsteps = 10\n")
    run = job_in(project)
    entries, code = code_of(run.recording)
    commit = git(project, "rev-parse", "HEAD")
    assert entries["git"] == f"{commit}-dirty"
    assert "+rate = 2" in code.patch
    assert run.file.provenance["git"] == find_run(run.run_id, run.folder.parent).file.provenance["git"]
    assert run.file.provenance["git"] == entries["git"]
    assert verify(run.recording).sound


def test_the_code_does_not_change_the_content(project):
    runs = [job_in(project), job_in(project, recording={"code": False})]
    assert len({run.summary["content_digest"] for run in runs}) == 1
    with open_recording(runs[1].recording) as recording:
        assert CODE_RECORD not in recording.file.metadata_names
        assert recording.code == Code()
        assert "command" not in recording.provenance


def test_a_resumed_run_has_the_code_of_its_beginning_or_of_its_end(project):
    config = from_mapping(LAKE)
    run = create_run(project / "recordings", config, 0)
    stopped = run_job(Job(config, 0), run, stop=stopping_after(3))
    first = code_of(stopped.recording)
    (project / "train.py").write_text("rate = 3\n")
    code_module._recent.clear()
    done = resume(stopped)
    assert done.status == "finished"
    entries, code = code_of(done.recording)
    assert entries["git"]
    assert (entries, code) == first or "+rate = 3" in code.patch
    assert verify(done.recording).sound


def test_the_code_is_carried_along(project, tmp_path):
    (project / "train.py").write_text("rate = 2\nsteps = 10\n")
    run = job_in(project, recording={"steps": "none"})
    expected = code_of(run.recording)
    exported = export_mcap(run, tmp_path / "one.mcap").path
    assert code_of(exported) == expected
    restore(archived(run.recording, tmp_path / "archive"), tmp_path / "back.mcap")
    assert code_of(tmp_path / "back.mcap") == expected
    assert code_of(rerecord(run).recording) == expected
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(run.recording.read_bytes()[:-100])
    repair(damaged)
    assert code_of(damaged) == expected


def test_an_anonymous_file_has_no_code(project, tmp_path):
    (project / "train.py").write_text("author = 'Ann'\n")
    git(project, "remote", "add", "origin", "git@example.org:ann/project.git")
    run = job_in(project)
    there = export_mcap(run, tmp_path / "one.mcap", anonymous=True).path
    with open_recording(there) as recording:
        assert CODE_RECORD not in recording.file.metadata_names
        assert CODE_ATTACHMENT not in recording.file.attachment_names
        assert not any(key.startswith("git") for key in recording.provenance)
        assert recording.provenance["package.numpy"]
    assert b"example.org:ann" not in there.read_bytes()


# --- two runs ----------------------------------------------------------------------------------------------


def test_two_commits_of_a_script(project, tmp_path):
    a = loop_in(project, 10)
    git(project, "commit", "-qam", "Train ten steps")
    git(project, "commit", "-q", "--allow-empty", "-m", "Begin again")
    b = loop_in(project, 20)
    git(project, "commit", "-qam", "Train twenty steps")
    text = dualtaxi(project, "diff", a, b)
    assert "2 lines of `train.py`" in text
    assert "-    for _ in range(10):" in text
    assert "+    for _ in range(20):" in text
    found = json.loads(dualtaxi(project, "diff", a, b, "--json"))
    (change,) = found["code"]
    assert (change["path"], change["added"], change["removed"]) == ("train.py", 1, 1)
    assert "+    for _ in range(20):" in change["lines"]
    marked = dualtaxi(project, "diff", a, b, "--markdown")
    assert "```diff\n--- A/train.py" in marked
    page = tmp_path / "page.html"
    dualtaxi(project, "diff", a, b, "--html", str(page))
    assert "<ins>+    for _ in range(20):</ins>" in page.read_text()
    assert dualtaxi(project, "diff", a, a, "--json")
    assert json.loads(dualtaxi(project, "diff", a, a, "--json"))["code"] == []


def test_the_patch_restores_the_code(project, tmp_path):
    (project / "models.py").write_text("layers = 2\n")
    run = loop_in(project, 10)
    dualtaxi(project, "code", run, "-o", str(tmp_path / "code.patch"))
    patch = (tmp_path / "code.patch").read_text()
    assert dualtaxi(project, "code", run, "-o", "-") == patch
    commit = git(project, "rev-parse", "HEAD")
    assert f"# git: {commit}-dirty" in patch
    assert "# command: train.py" in patch
    copy = tmp_path / "copy"
    git(tmp_path, "clone", "-q", str(project), str(copy))
    git(copy, "apply", str(tmp_path / "code.patch"))
    assert (copy / "train.py").read_text() == LOOP.format(steps=10)
    assert (copy / "models.py").read_text() == "layers = 2\n"
    values = json.loads(dualtaxi(project, "code", run, "--json"))
    assert values["files"]["train.py"] == LOOP.format(steps=10)
    assert values["new"] == ["models.py"]
    assert values["packages"]["numpy"] == np.__version__
    text = dualtaxi(project, "code", run)
    assert "+" + LOOP.format(steps=10).splitlines()[-1] in text
    assert re.search(r"models.py +not in the commit +1$", text, re.MULTILINE)
    assert "Packages" not in dualtaxi(project, "show", run)


def test_a_command_that_is_not_wanted_is_not_read(project, monkeypatch):
    monkeypatch.setattr(sys, "argv", [Path("train.py"), 3])  # as some programs set it
    run = job_in(project, recording={"code": False})
    with open_recording(run.recording) as recording:
        assert "command" not in recording.provenance


def test_a_run_without_its_code(project, monkeypatch):
    monkeypatch.setenv("DUALTAXI_CODE", "off")
    run = loop_in(project, 10)
    assert "was not recorded" in dualtaxi(project, "code", run)


# --- hostile files -----------------------------------------------------------------------------------------


def packed(value: object) -> bytes:
    return zstandard.ZstdCompressor().compress(json.dumps(value).encode())


@pytest.mark.parametrize(
    "data",
    [
        b"nothing",
        packed([]),
        packed({"files": {}, "new": []}),
        packed({"files": {"a.py": 3}, "new": [], "patch": ""}),
        packed({"files": {"../a.py": ""}, "new": [], "patch": ""}),
        packed({"files": {"/etc/a.py": ""}, "new": [], "patch": ""}),
        packed({"files": {"a\x1b.py": ""}, "new": [], "patch": ""}),
        packed({"files": {"a.py": ""}, "new": ["b.py"], "patch": ""}),
        packed({"files": {f"{k}.py": "" for k in range(3000)}, "new": [], "patch": ""}),
        zstandard.ZstdCompressor().compress(bytes(200 << 20)),
    ],
)
def test_damaged_code_is_refused(data):
    with pytest.raises(RecordingError):
        parse_code(data, "here")


def with_code(project: Path, code: Code, **entries: str) -> Path:
    """Return a run whose recording claims this code."""
    run = job_in(project, recording={"code": False})
    fresh = run.folder / "fresh.mcap"
    from runner.recording.rewriting import rewrite

    original = RecordingFile.finish

    def finish(self, *arguments):
        self.add_attachment(CODE_ATTACHMENT, "application/zstd", code.to_attachment())
        original(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RecordingFile, "finish", finish)
        rewrite(run.recording, fresh, lambda _, values: values, {CODE_RECORD: entries})
    fresh.replace(run.recording)
    return run.recording


def test_what_a_recording_claims_cannot_replace_its_provenance(project):
    path = with_code(project, Code({"a.py": ""}), host="elsewhere", git="abc")
    with open_recording(path) as recording:
        assert recording.provenance["host"] != "elsewhere"
        assert recording.provenance["git"] == "abc"


def test_pages_escape_code(project):
    from fastapi.testclient import TestClient

    from runner.service.app import create_app
    from runner.service.settings import ServiceSettings

    evil = "<script>alert(1)</script>"
    code = Code(
        {"a.py": evil, f"b{evil.replace('/', '')}.py": ""}, (), f"diff --git a/x b/x\n+{evil}\n-{evil}\n"
    )
    path = with_code(project, code, **{"git.branch": evil, "code.script": "a.py"})
    other = job_in(project)
    settings = ServiceSettings(recordings=(path.parent.parent,), tokens=project.parent / "tokens.json")
    with TestClient(create_app(settings), base_url="http://localhost") as client:
        for address in (
            f"/runs/{path.parent.name}/code",
            f"/runs/{path.parent.name}/config",
            f"/compare/code?run={path.parent.name}&run={other.run_id}",
        ):
            answer = client.get(address, headers={"Accept": "text/html"})
            assert answer.status_code == 200, answer.text
            assert evil not in answer.text
            assert "<script>alert" not in answer.text
        shown = client.get(f"/runs/{path.parent.name}/code").text
        assert "<ins>+&lt;script&gt;alert(1)&lt;/script&gt;</ins>" in shown
        assert "&lt;script&gt;alert(1)&lt;/script&gt;" in shown
