"""What is well formed in a page, and what it refers to."""

from __future__ import annotations

import re
from html.parser import HTMLParser

VOID = {"meta", "link", "input", "br", "wbr", "hr", "img"}


class Outline(HTMLParser):
    """Checks that elements are closed in order, and keeps what a page refers to."""

    def __init__(self):
        super().__init__()
        self.open, self.addresses, self.ids, self.cells = [], [], [], []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.ids += [values["id"]] if "id" in values else []
        self.addresses += [v for k, v in attrs if k in ("src", "href", "xlink:href", "action", "data")]
        if tag == "th":
            self.cells.append(values.get("scope"))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, tag


def check_page(page: str) -> None:
    """Check that a page is well formed, needs no network, and that its links lead somewhere in it."""
    outline = Outline()
    outline.feed(page)
    assert outline.open == []
    assert all(address.startswith("#") for address in outline.addresses)
    assert not re.search(r"url\((?!#)|@import|https?://(?!www\.w3\.org/)", page)
    assert len(outline.ids) == len(set(outline.ids))
    assert set(outline.cells) <= {"row", "col"}
    assert {address[1:] for address in outline.addresses} <= set(outline.ids)
    assert len(page) < 1_000_000
