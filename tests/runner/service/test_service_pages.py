"""Pages as programs see them: answered, escaped, well formed, with nothing inline that the policy forbids."""

from __future__ import annotations

import re

import pytest

from tests.runner.export.outline import Outline

SAYS_HTML = {"Accept": "text/html"}


def page_of(client, address, status=200):
    answer = client.get(address, headers=SAYS_HTML)
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"].startswith("text/html")
    outline = Outline()
    outline.feed(answer.text)
    assert outline.open == []
    assert len(outline.ids) == len(set(outline.ids))
    assert not re.search(r"<style|\sstyle=|\son\w+=|<script(?![^>]*\ssrc=)|javascript:", answer.text)
    assert all(address[:1] in ("/", "#", "?") for address in outline.addresses), outline.addresses
    return answer.text


def test_the_first_page_is_the_runs(client):
    answer = client.get("/", follow_redirects=False)
    assert answer.headers["location"] == "/runs"
    page = page_of(client, "/runs")
    assert page.count("<tr>") == 3
    assert "2 runs" in page


def test_runs_are_searched_sorted_and_their_columns_chosen(client):
    page = page_of(client, "/runs?filter=name:second&columns=name,config.discount&sort=-name")
    assert "1 of 2 run" in page
    assert re.search(r"<a[^>]*>second</a></td><td>0.99</td>", page)
    assert "first</a>" not in page


@pytest.mark.parametrize("query", ["filter=status:", "sort=bogus", "columns=bogus"])
def test_a_filter_that_is_none_is_told(client, query):
    page = page_of(client, f"/runs?{query}", 400)
    assert 'role="alert"' in page


def test_what_is_missing_is_told_as_a_page(client):
    assert "there is nothing at /nowhere" in page_of(client, "/nowhere", 404)
    assert client.get("/nowhere").json()["error"]["message"]


def test_files_are_kept_for_ever_and_compressed(client):
    address = re.search(r'"(/static/[^"]*style.css)"', page_of(client, "/runs"))[1]
    answer = client.get(address)
    assert "immutable" in answer.headers["cache-control"]
    assert answer.headers["content-encoding"] == "gzip"
    assert client.get("/static/older/style.css").headers["cache-control"] == "no-cache"
    assert client.get("/static/x/../../app.py").status_code >= 400


def test_a_runs_name_cannot_break_out(client, recordings):
    run = next(path.parent for path in recordings.glob("*/run.json"))
    (run / "labels.json").write_text('{"name": "<script>alert(1)</script>", "note": "\\"><img src=x>"}')
    page = page_of(client, "/runs?columns=id,name,note")
    assert "&lt;script&gt;alert(1)" in page
    assert "<img src=x" not in page
