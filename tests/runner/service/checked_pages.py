"""Pages of the service, checked as they are fetched."""

from __future__ import annotations

import re

from tests.runner.export.outline import Outline

ACCEPT_HTML = {"Accept": "text/html"}


def page_of(client, address, status=200):
    """Return a page's HTML after checking that it is well formed and has nothing inline or foreign."""
    answer = client.get(address, headers=ACCEPT_HTML)
    assert answer.status_code == status, (address, answer.text)
    assert answer.headers["content-type"].startswith("text/html")
    outline = Outline()
    outline.feed(answer.text)
    assert outline.open == []
    assert len(outline.ids) == len(set(outline.ids))
    assert not re.search(r"<style|\sstyle=|\son\w+=|<script(?![^>]*\ssrc=)|javascript:", answer.text)
    own = ("/", "#", "?", "data:image/")
    assert [other for other in outline.addresses if not other.startswith(own)] == [], address
    return answer.text
