"""Submitted texts are checked as files are, and for what a server must not do."""

from __future__ import annotations

import asyncio
import contextlib
from concurrent.futures import ThreadPoolExecutor

import pytest

from runner.config import load
from runner.errors import ConfigError
from runner.service.jobs import checking
from runner.service.jobs.checking import JobChecker, check
from runner.sweep import state
from runner.sweep.model import from_values

TINY = "env: {id: FrozenLake-v1}\nepisodes: 3\nseeds: [0, 1]\n"
SWEEP = """\
name: small
base: {env: {id: FrozenLake-v1}, episodes: 10, evaluation: {every: 5, trials: 2}}
strategy: grid
parameters: {step_size: [0.1, 0.5, 1.0]}
seeds: [0, 1]
objective: {metric: training.mean_reward}
"""


def check_in_child(checker, text, source):
    return asyncio.run(checker.check(text, source))


def refused(text, tmp_path):
    with pytest.raises(ConfigError) as caught:
        check(text, "job.yaml", tmp_path)
    return caught.value


def test_a_text_has_the_meaning_of_the_file(tmp_path):
    file = tmp_path / "tiny.yaml"
    file.write_text(TINY)
    found = check(TINY, "tiny.yaml", tmp_path)
    assert found.values == load(file).to_mapping()
    assert (found.kind, found.name, found.runs) == ("config", "tiny", 2)
    assert found.bytes > 0


def test_a_sweep_is_recognised_by_its_keys(tmp_path):
    found = check(SWEEP, "job.yaml", tmp_path)
    assert (found.kind, found.name, found.runs) == ("sweep", "small", 6)
    assert from_values(found.values).to_mapping() == found.values


def test_mistakes_have_the_lines_of_the_file(tmp_path):
    text = "episodes: many\nepsilom: 0.1\n"
    file = tmp_path / "job.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as of_file:
        load(file)
    of_text = refused(text, tmp_path)
    assert str(of_text) == str(of_file.value).replace(str(file), "job.yaml")
    assert [(found.path, found.line) for found in of_text.problems] == [("episodes", 1), ("epsilom", 2)]
    assert refused(SWEEP.replace("0.5,", "7.0,"), tmp_path).problems[0].line == 4


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("episodes: 3\nenv: {id: FrozenLake-v999}\n", 2, "FrozenLake-v1"),
        ("episodes: 3\n\ninitial_q: {run: nobody}\n", 3, "no run 'nobody'"),
        ("episodes: 3\ninitial_q: {run: /etc/passwd}\n", 2, "found the path '/etc/passwd'"),
        ("episodes: 3\ninitial_q: {run: ../x.mcap}\n", 2, "found the path"),
        (SWEEP.replace("{env", "{initial_q: {run: a/b}, env"), 2, "found the path 'a/b'"),
        (SWEEP.replace("10, e", "10,\n  initial_q: {run: a/b}, e"), 3, "found the path 'a/b'"),
        (SWEEP.replace("{step_size: [0.1,", "{initial_q: [{run: x.mcap},"), 4, "found the path 'x.mcap'"),
        (SWEEP.replace("{step_size: [0.1, 0.5, 1.0]", "{initial_q.run: [/x]"), 4, "found the path '/x'"),
        ("base: cooperative.yaml\nstrategy: grid\nparameters: {discount: [0.1]}\n", 1, "found the path"),
    ],
)
def test_mistakes_on_a_server_only_have_lines_too(text, line, message, tmp_path):
    error = refused(text, tmp_path)
    assert error.problems[0].line == line, error
    assert message in str(error)


def test_a_sweep_can_be_resumed_but_not_changed(tmp_path):
    state.begin(from_values(check(SWEEP, "job.yaml", tmp_path).values), tmp_path, False, False)
    assert check(SWEEP, "job.yaml", tmp_path).name == "small"
    error = refused(SWEEP.replace("0.5", "0.6"), tmp_path)
    assert "a sweep 'small' is here already, and differs in parameters.step_size" in str(error)
    assert error.problems[0].line == 1


def test_a_job_with_too_many_runs_is_refused(tmp_path):
    assert "makes 10,001 runs" in str(refused("episodes: 1\nseeds: {count: 10001}\n", tmp_path))


def test_the_child_process_returns_the_result_of_the_function(tmp_path):
    with contextlib.closing(JobChecker(tmp_path)) as checker:
        assert check_in_child(checker, TINY, "tiny.yaml") == check(TINY, "tiny.yaml", tmp_path)
        with pytest.raises(ConfigError) as caught:
            check_in_child(checker, "episodes: many", "job.yaml")
        assert caught.value.problems == refused("episodes: many", tmp_path).problems
        with pytest.raises(ConfigError, match=r"larger than 1\.0 MB"):
            check_in_child(checker, "x" * (1 << 20) + "x", "job.yaml")


def test_an_environment_that_hangs_or_kills_affects_only_its_own_process(tmp_path, environments, monkeypatch):
    with contextlib.closing(JobChecker(tmp_path)) as checker:
        with pytest.raises(ConfigError, match="ended the process that was checking it"):
            check_in_child(checker, environments["killing"], "job.yaml")
        assert check_in_child(checker, TINY, "tiny.yaml").runs == 2
    monkeypatch.setattr(checking, "CHECK_SECONDS", 1.0)
    with (
        contextlib.closing(JobChecker(tmp_path)) as checker,
        pytest.raises(ConfigError, match="took longer than 1 s to check"),
    ):
        check_in_child(checker, environments["hanging"], "job.yaml")


def test_an_environment_that_needs_too_much_memory_is_refused(tmp_path, environments, monkeypatch):
    monkeypatch.setattr(checking, "MEMORY_BYTES", 256 << 20)
    with contextlib.closing(JobChecker(tmp_path)) as checker:
        with pytest.raises(ConfigError, match=r"needs more than 268 MB of memory"):
            check_in_child(checker, environments["greedy"], "job.yaml")
        assert check_in_child(checker, TINY, "tiny.yaml").runs == 2


def test_checks_that_hang_do_not_block_other_requests(client, environments):
    with ThreadPoolExecutor(10) as threads:
        hanging = [
            threads.submit(client.post, "/api/v1/jobs/check", content=environments["hanging"])
            for _ in range(10)
        ]
        for path in ("/runs", "/api/v1/runs", "/queue", "/submit"):
            assert client.get(path).status_code == 200
        assert not any(check.done() for check in hanging), "all of them hung meanwhile"
        client.app.state.jobs.checker.close()
        assert {check.result().status_code for check in hanging} <= {422, 503}


@pytest.fixture
def environments(tmp_path, monkeypatch):
    """Return configurations by what their environment does when it is imported."""
    monkeypatch.syspath_prepend(tmp_path)
    codes = {
        "hanging": "import time\ntime.sleep(600)\n",
        "killing": "import os\nos._exit(3)\n",
        "greedy": "data = bytearray(1 << 30)\n",
    }
    for name, code in codes.items():
        (tmp_path / f"{name}.py").write_text(code)
    monkeypatch.setenv("DUALTAXI_PACKAGES", ", ".join(codes))
    return {name: f"episodes: 1\nenv: {{id: '{name}:X-v0'}}\n" for name in codes}
