"""The user's code: what git tells of it within limits, and what a recording gets."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest

from runner.recording.code import MAX_CODE_BYTES, Code, parse_code
from runner.runs.code import NotRecorded, collect, read_repository
from tests.runner.runs.repositories import git, new_project

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


@pytest.fixture
def project(tmp_path):
    return new_project(tmp_path / "project")


def read(folder: Path, script: Path | None = None) -> tuple[dict[str, str], Code]:
    found = collect(folder, script)
    return found.entries, parse_code(found.attachment, "here") if found.attachment else Code()


def test_a_clean_repository(project):
    git(project, "remote", "add", "origin", "git@example.org:team/project.git")
    entries, code = read(project, project / "train.py")
    assert entries == {
        "git": git(project, "rev-parse", "HEAD"),
        "git.branch": "main",
        "git.remote": "git@example.org:team/project.git",
        "code.script": "train.py",
    }
    assert code == Code({"train.py": "rate = 1\nsteps = 10\n"})
    assert code.to_patch() == ""


def test_commit_and_patch_give_the_code_back(project, tmp_path):
    (project / "train.py").write_text("rate = 2\nsteps = 10\n")
    (project / "part").mkdir()
    (project / "part" / "model of mine.py").write_text("layers = 3")
    (project / "empty.py").write_text("")
    (project / "ignored.py").write_text("")
    (project / "numbers.bin").write_bytes(bytes(100))
    entries, code = read(project, project / "train.py")
    commit = git(project, "rev-parse", "HEAD")
    assert entries["git"] == f"{commit}-dirty"
    assert code.new == ("empty.py", "part/model of mine.py")
    copy = tmp_path / "copy"
    git(tmp_path, "clone", "-q", str(project), str(copy))
    (tmp_path / "code.patch").write_text(code.to_patch())
    git(copy, "apply", str(tmp_path / "code.patch"))
    for name in ("train.py", "part/model of mine.py", "empty.py"):
        assert (copy / name).read_text() == (project / name).read_text()
    assert not (copy / "ignored.py").exists()


def test_an_ignored_script_is_part_of_the_patch(project):
    (project / "ignored.py").write_text("rate = 3\n")
    _, code = read(project, project / "ignored.py")
    assert code.files == {"ignored.py": "rate = 3\n"}
    assert "+rate = 3" in code.to_patch()


def test_a_script_without_a_repository_comes_back_from_its_patch(tmp_path):
    (tmp_path / "train.py").write_text("rate = 2\n")
    entries, code = read(tmp_path, tmp_path / "train.py")
    assert entries == {"code.script": "train.py", "git.not_recorded": "there is no git repository"}
    copy = tmp_path / "copy"
    copy.mkdir()
    git(copy, "init", "-q")
    (tmp_path / "code.patch").write_text(code.to_patch())
    git(copy, "apply", str(tmp_path / "code.patch"))
    assert (copy / "train.py").read_text() == "rate = 2\n"


def test_before_the_first_commit(tmp_path):
    git(tmp_path, "init", "-q")
    (tmp_path / "train.py").write_text("rate = 2\n")
    git(tmp_path, "add", "-A")
    entries, code = read(tmp_path, tmp_path / "train.py")
    assert entries["git.not_recorded"] == "there is no commit yet"
    assert "git" not in entries
    assert code.new == ("train.py",)


def test_a_commit_that_was_checked_out_by_itself_has_no_branch(project):
    git(project, "checkout", "-q", "--detach")
    entries, _ = read(project)
    assert entries == {"git": git(project, "rev-parse", "HEAD")}


def test_a_bare_repository(project, tmp_path):
    bare = tmp_path / "bare.git"
    git(tmp_path, "clone", "-q", "--bare", str(project), str(bare))
    entries, code = read(bare)
    assert entries == {"git.not_recorded": "the repository is bare: it has no files"}
    assert code == Code()


def test_secrets_are_removed(project):
    token = "ghp_" + "a1B2" * 9
    git(project, "remote", "add", "origin", f"https://me:{token}@example.org/p.git")
    (project / "train.py").write_text(f'TOKEN = "{token}"\nsteps = 10\n')
    (project / "secrets.yaml").write_text(f"token: {token}\n")
    found = collect(project, project / "train.py")
    entries, code = read(project, project / "train.py")
    assert entries["git.remote"] == "https://[redacted]@example.org/p.git"
    assert code.files["train.py"] == 'TOKEN = "[redacted]"\nsteps = 10\n'
    assert '+TOKEN = "[redacted]"' in code.patch
    assert "secrets.yaml" not in code.files
    assert token not in f"{found.entries}{code}"


@pytest.mark.parametrize(
    "name",
    [
        *(
            ".env",
            "conf/.env.local",
            "prod.env",
            "server.pem",
            "tls/a.key",
            "id_rsa",
            "id_work",
            "aws_credentials",
        ),
        *(
            "client_secret.json",
            "secrets/x.py",
            ".netrc",
            ".pypirc",
            "store.p12",
            "api-token.yaml",
            'mY"Secret',
        ),
    ],
)
def test_a_file_with_the_name_of_a_secret_is_named_and_not_stored(project, name):
    path = project / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("before\n")
    git(project, "add", "-A")
    git(project, "commit", "-qm", "Add it")
    path.write_text("DB=p@ss word!\n")
    (project / "train.py").write_text("rate = 2\n")
    entries, code = read(project, path)
    assert f"{name} (it has the name of a secret)" in entries["code.left_out"]
    assert entries["git"].endswith("-dirty")
    assert "p@ss" not in f"{entries}{code}"
    assert "before" not in code.patch
    assert "+rate = 2" in code.patch
    path.unlink()
    assert "before" not in read(project)[1].patch


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are text there")
def test_a_secret_whose_name_is_no_text_is_not_in_the_patch(project):
    path = project / os.fsdecode(b"\xff.env")
    for text in ("before\n", "DB=p@ss word!\n"):
        git(project, "commit", "-qm", "Change it", "--allow-empty")
        path.write_text(text)
        git(project, "add", "-A")
    assert read(project)[1].patch == ""


@pytest.mark.parametrize("name", ["environment.py", "secretary.py", "id_mapping.py", "monkey.py"])
def test_a_source_with_a_harmless_name_is_recorded(project, name):
    (project / name).write_text("x = 1\n")
    _, code = read(project, project / name)
    assert code.files == {name: "x = 1\n"}


def test_submodules_are_recorded_by_their_commits(project, tmp_path):
    git(project, "-c", "protocol.file.allow=always", "submodule", "add", "-q", str(project), "part")
    git(project, "commit", "-qm", "Add a part")
    git(project, "config", "diff.submodule", "log")
    before = git(project / "part", "rev-parse", "HEAD")
    git(project / "part", "commit", "-q", "--allow-empty", "-m", "Go on")
    after = git(project / "part", "rev-parse", "HEAD")
    _, code = read(project)
    assert f"-Subproject commit {before}\n+Subproject commit {after}" in code.patch


def test_50_000_untracked_files(project):
    folder = project / "outputs"
    folder.mkdir()
    (folder / "0.json").write_text("[1]")
    for number in range(1, 50_000):  # links, which are made in a third of the time
        os.link(folder / "0.json", f"{folder}/{number}.json")
    entries, code = read(project, project / "train.py")
    assert entries["git"].startswith(git(project, "rev-parse", "HEAD"))
    assert code.files["train.py"]
    assert sum(map(len, code.files.values())) <= MAX_CODE_BYTES
    assert "code.left_out" in entries or "git.not_recorded" in entries or len(code.new) == 50_000


def test_what_is_too_large_is_named(project):
    (project / "train.py").write_text("x = 1\n" * 100_000)
    for number in range(5):
        (project / f"part{number}.py").write_text("y = 1\n" * 40_000)
    entries, code = read(project, project / "train.py")
    assert "train.py (600,000 bytes)" in entries["code.left_out"]
    assert "the changes of train.py" in entries["code.left_out"]
    assert "part4.py (240,000 bytes)" in entries["code.left_out"]
    assert sorted(code.files) == ["part0.py", "part1.py", "part2.py", "part3.py"]


def test_links_and_pipes_are_not_read(project, tmp_path):
    (tmp_path / "private.py").write_text("mine")
    (project / "link.py").symlink_to(tmp_path / "private.py")
    os.mkfifo(project / "pipe.py")
    _, code = read(project, project / "train.py")
    assert sorted(code.files) == ["train.py"]


def test_a_repository_of_another_user_is_not_read(project, monkeypatch):
    monkeypatch.setenv("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")
    # git knows this variable from its own tests; the reader removes every variable of git
    program = project.parent / "bin" / "git"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nGIT_TEST_ASSUME_DIFFERENT_OWNER=1 exec {shutil.which("git")} "$@"\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    entries, code = read(project, project / "train.py")
    assert "does not trust the repository" in entries["git.not_recorded"]
    assert "git" not in entries
    assert code.files == {"train.py": "rate = 1\nsteps = 10\n"}


def test_git_that_is_not_installed(project, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    entries, code = read(project, project / "train.py")
    assert entries == {"code.script": "train.py", "git.not_recorded": "git is not installed"}
    assert code.files == {"train.py": "rate = 1\nsteps = 10\n"}


def test_a_broken_repository(project):
    (project / ".git" / "HEAD").write_text("nothing\n")
    entries, code = read(project, project / "train.py")
    assert entries["git.not_recorded"]
    assert "git" not in entries
    assert code.files


def test_a_damaged_index_leaves_the_commit(project):
    (project / ".git" / "index").write_bytes(b"nothing")
    entries, _ = read(project, project / "train.py")
    assert entries["git"] == git(project, "rev-parse", "HEAD")
    assert "index" in entries["git.not_recorded"]


def test_a_hanging_git_is_stopped(project, monkeypatch):
    program = project.parent / "bin" / "git"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\nsleep 60 & sleep 60\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    began = time.monotonic()
    with pytest.raises(NotRecorded, match=r"was stopped: reading the repository took 0\.2 s"):
        read_repository(project, seconds=0.2)
    assert time.monotonic() - began < 30  # not the minute that it sleeps


def test_commit_branch_and_remote_are_known_before_slow_changes(project, monkeypatch):
    from runner.recording.writer import create_recording
    from runner.runs import code as module

    program, reached, released = (project.parent / name for name in ("bin/git", "reached", "released"))
    program.parent.mkdir()
    program.write_text(
        f'#!/bin/sh\ncase "$*" in *" status "*) touch {reached}\n'
        f"while [ ! -e {released} ]; do sleep 0.05; done;; esac\n"
        f'exec {shutil.which("git")} "$@"\n'
    )
    program.chmod(0o755)
    git(project, "remote", "add", "origin", "https://user:secret@example.org/project.git")
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.delenv("DUALTAXI_CODE")
    monkeypatch.chdir(project)
    monkeypatch.setattr(module, "user_script", lambda: None)
    monkeypatch.setattr(module, "WAIT_SECONDS", 0.01)
    monkeypatch.setattr(module, "read_repository", partial(read_repository, seconds=60))
    collector = module.CodeCollector(project / "recordings")
    while not reached.exists():
        time.sleep(0.01)
    with create_recording(project / "recording.mcap") as file:
        collector.write(file, wait=True)
    released.touch()
    for thread in threading.enumerate():
        if thread.name == "recording-code":
            thread.join()
    assert collector.entries == {
        "git": git(project, "rev-parse", "HEAD"),
        "git.branch": "main",
        "git.remote": "https://[redacted]@example.org/project.git",
        "git.not_recorded": "what differs from the commit: reading it took more than 0.01 s",
        "code.not_recorded": "reading it took more than 0.01 s",
    }


def test_nothing_that_the_repository_configures_is_executed(project, tmp_path):
    mark = tmp_path / "executed"
    script = tmp_path / "evil.sh"
    script.write_text(f"#!/bin/sh\necho $0 >> {mark}\ncat\n")
    script.chmod(0o755)
    hooks = tmp_path / "hooks"
    hooks.mkdir()
    for hook in ("post-index-change", "fsmonitor-watchman", "post-checkout"):
        shutil.copy(script, hooks / hook)
    (project / ".gitattributes").write_text("*.py filter=evil diff=evil\n*.txt filter=run diff=text\n")
    (project / "notes.txt").write_text("a\n")
    git(project, "add", "-A")
    git(project, "commit", "-qm", "Add attributes")
    for key, value in {
        "core.fsmonitor": script,
        "core.hooksPath": hooks,
        "core.pager": script,
        "diff.external": script,
        "diff.evil.command": script,
        "diff.text.textconv": script,
        "filter.evil.clean": script,
        "filter.evil.smudge": script,
        "filter.evil.required": "true",
        "filter.run.process": script,
        "filter.run.required": "true",
        "credential.helper": script,
        "alias.status": f"!{script}",
    }.items():
        git(project, "config", key, str(value))
    (project / "train.py").write_text("rate = 2\nsteps = 10\n")
    (project / "notes.txt").write_text("b\n")
    entries, code = read(project, project / "train.py")
    assert not mark.exists(), mark.read_text()
    assert "git.not_recorded" not in entries
    assert "+rate = 2" in code.patch
    assert "+b" in code.patch


def test_a_working_tree_that_is_elsewhere_is_not_read(project, tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "diary.py").write_text("mine")
    git(project, "config", "core.worktree", str(tmp_path / "home"))
    entries, code = read(project, project / "train.py")
    assert "git.not_recorded" in entries
    assert not any("diary.py" in path for path in code.files)


def test_git_reads_no_settings_from_the_environment(project, monkeypatch, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    git(other, "init", "-q")
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    assert read_repository(project).root == project.resolve()


SCRIPT = """
import gymnasium, runner, models
with runner.record(gymnasium.make("CartPole-v1"), "recordings"{more}) as env:
    env.reset(seed=0)
    for _ in range(20):
        if env.step(0)[2]:
            env.reset()
"""


def run_script(folder: Path, *arguments: str, more: str = "", **variables: str) -> dict[str, str]:
    from runner.recording.reader import open_recording

    (folder / "train.py").write_text(SCRIPT.format(more=more))
    (folder / "models.py").write_text("layers = 2\n")
    settings = {name: value for name, value in os.environ.items() if name != "DUALTAXI_CODE"} | variables
    path = os.pathsep.join(sys.path)
    command = [sys.executable, "train.py", *arguments]
    subprocess.run(command, cwd=folder, check=True, env=settings | {"PYTHONPATH": path}, capture_output=True)
    (run,) = (folder / "recordings").iterdir()
    with open_recording(run / "recording.mcap") as recording:
        return {
            **recording.provenance,
            **{f"file {path}": text for path, text in recording.code.files.items()},
        }


def test_a_loop_records_script_modules_and_arguments(project):
    found = run_script(project, "--api-key", "abcdef", "--rate", "0.5", DATABASE_PASSWORD="correct horse 7")
    assert found["command"] == "train.py --api-key '[redacted]' --rate 0.5"
    assert found["git"] == git(project, "rev-parse", "HEAD") + "-dirty"
    assert found["code.script"] == "train.py"
    assert found["file models.py"] == "layers = 2\n"
    assert "runner.record" in found["file train.py"]
    assert found["package.gymnasium"]
    assert not any("PASSWORD" in key for key in found)


@pytest.mark.parametrize(("more", "variables"), [(", code=False", {}), ("", {"DUALTAXI_CODE": "off"})])
def test_one_setting_turns_it_off(project, more, variables):
    found = run_script(project, "--rate", "0.5", more=more, **variables)
    assert not any(key.startswith(("git", "code.", "file ", "command")) for key in found)
    assert found["package.gymnasium"]


def test_a_training_in_a_folder_that_hangs_ends_all_the_same(project, monkeypatch):
    from runner.recording.writer import create_recording
    from runner.runs import code as module

    monkeypatch.delenv("DUALTAXI_CODE")
    monkeypatch.setattr(module, "WAIT_SECONDS", 0.2)
    released = threading.Event()
    monkeypatch.setattr(module, "collect", lambda *_: released.wait(60))
    collector = module.CodeCollector(project / "recordings")
    with create_recording(project / "recording.mcap") as file:
        collector.write(file)
        assert not collector.entries
        collector.write(file, wait=True)
    released.set()
    assert collector.entries == {"code.not_recorded": "reading it took more than 0.2 s"}
