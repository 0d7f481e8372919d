"""The service against its own description: only documented responses, and no server errors."""

from __future__ import annotations

import shutil
import traceback

import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from served import Served

pytestmark = pytest.mark.long

EXAMPLES = 2
"""Requests to each route: a number, not a time, so that a failure is found again when it is repeated."""
TIMEOUT = 300
"""Seconds that a request may take on a loaded machine."""
LONGEST = 60_000
"""Of an address, in characters; of longer ones the service's HTTP parser says that they are none."""


@pytest.fixture(scope="module")
def served(recorded, tmp_path_factory):
    recordings = shutil.copytree(recorded, tmp_path_factory.mktemp("fuzz") / "recordings")
    with Served(recordings) as server:
        yield server


def test_every_response_is_documented_and_none_is_a_server_error(served):
    import schemathesis  # here, as it takes a second of every worker that collects the tests
    from schemathesis.core.failures import FailureGroup

    schema = schemathesis.openapi.from_url(f"{served.url}/api/v1/openapi.json")
    failed, tried = {}, 0
    for result in schema.get_all_operations():
        operation = result.ok()
        if "text/event-stream" in str(operation.definition.raw):
            continue  # it ends when the job does
        try:
            _fuzz(operation, served)
        except (Exception, FailureGroup) as error:  # reported at the end, with all others
            failed[operation.label] = "".join(traceback.format_exception_only(error))[:2000]
        tried += 1
    assert tried > 20
    assert not failed, "\n\n".join(f"{label}: {message}" for label, message in failed.items())


def _cases(operation):
    """Return requests that fit the description, and such that do not."""
    from schemathesis.generation import GenerationMode

    return st.one_of(*(operation.as_strategy(generation_mode=mode) for mode in GenerationMode))


def _checks():
    from schemathesis import checks
    from schemathesis.specs.openapi import checks as described

    return [
        checks.not_a_server_error,
        described.status_code_conformance,
        described.content_type_conformance,
        described.response_schema_conformance,
    ]


def _fuzz(operation, served):
    @seed(0)
    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=_cases(operation), name=st.sampled_from(["first", "second", "@latest", None]))
    def check(case, name):
        if name is not None:
            _name_runs(case, name)
        answer = case.call(headers=served.origin, timeout=TIMEOUT)
        if len(str(answer.request.url)) <= LONGEST:
            case.validate_response(answer, checks=_checks())

    check()


def _name_runs(case, name):
    """Have a request ask for runs that there are."""
    if "run" in (case.path_parameters or {}):
        case.path_parameters["run"] = name
    for key, value in (("a", "first"), ("b", name), ("run", ["first", name])):
        if key in (case.query or {}):
            case.query[key] = value
