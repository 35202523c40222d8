"""What a browser and a screen reader find on a page, read by Python's own parser."""

import itertools
import re
from html.parser import HTMLParser

VOID = {"meta", "link", "br", "img", "hr", "input"}


class Page(HTMLParser):
    """ids, anchors, addresses, headings, figures, tables and machine-readable numbers of a page."""

    def __init__(self, source: str):
        super().__init__()
        self.source = source
        self.open: list[tuple[str, dict]] = []
        self.ids: list[str] = []
        self.anchors: list[str] = []
        self.addresses: list[str] = []
        self.headings: list[tuple[int, str]] = []
        self.drawings: list[str] = []
        self.cells_without_scope = 0
        self.values: list[float] = []
        self.sections: dict[str, str] = {}
        self.paths = 0
        self.feed(source)
        self.close()
        assert not self.open, f"not closed: {[tag for tag, _ in self.open]}"

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if tag not in VOID:
            self.open.append((tag, given))
        if "id" in given:
            self.ids.append(given["id"])
        for name in ("href", "src", "srcset", "action", "data", "poster", "xlink:href"):
            if given.get(name):
                target = given[name]
                (self.anchors if target.startswith("#") else self.addresses).append(target.removeprefix("#"))
        if re.fullmatch("h[1-6]", tag):
            self.headings.append((int(tag[1]), ""))
        if tag == "svg" and given.get("aria-hidden") != "true":
            assert given.get("role") == "img"
            self.drawings.append(given["aria-label"])
        if tag == "th" and given.get("scope") not in ("row", "col"):
            self.cells_without_scope += 1
        if tag == "data":
            self.values.append(float(given["value"]))
        self.paths += tag == "path"

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        opened, _ = self.open.pop()
        assert opened == tag, f"<{opened}> closed by </{tag}>"

    def handle_data(self, data):
        inside = [(tag, given) for tag, given in self.open]
        for tag, given in inside:
            if tag == "section":
                self.sections[given["id"]] = self.sections.get(given["id"], "") + data
        if inside and re.fullmatch("h[1-6]", inside[-1][0]):
            level, before = self.headings[-1]
            self.headings[-1] = level, before + data


def check(source: str) -> Page:
    """The page, well-formed and without any address outside of it."""
    page = Page(source)
    assert len(source.encode()) < 2_000_000
    assert len(page.ids) == len(set(page.ids))
    assert set(page.anchors) <= set(page.ids)
    assert all(address.startswith("data:") for address in page.addresses)
    assert not re.search(r"https?:|//[a-z]|@import|<script|javascript:|url\((?!#)", source)
    assert next(level for level, _ in page.headings) == 1
    levels = [level for level, _ in page.headings]
    assert levels.count(1) == 1 and all(b - a <= 1 for a, b in itertools.pairwise(levels))
    assert all(len(label) > 20 for label in page.drawings)
    assert page.cells_without_scope == 0
    assert 'lang="en"' in source and 'class="skip" href="#main"' in source
    assert not re.search(r"\bnan\b|\binf\b|(?<!mean=)None", re.sub(r"<[^>]*>", " ", source.partition("<body>")[2]))
    return page
