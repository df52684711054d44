"""Parses a report page; fails if it is not well-formed or not self-contained."""

from html.parser import HTMLParser

VOID = {"meta", "img", "br", "hr", "link", "input"}


class PageParser(HTMLParser):
    """Collects tags, attributes and text; fails if tags do not nest."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def parsed_page(page: str) -> PageParser:
    """The parsed page: its tags nest, it requests nothing, and all its pictures are within it."""
    parser = PageParser()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    assert page.startswith("<!DOCTYPE html>")
    assert not {"script", "link", "iframe", "object"} & {tag for tag, _ in parser.seen}
    sources = [
        v for tag, attrs in parser.seen for k, v in attrs.items() if k in ("src", "srcset", "href") and tag != "a"
    ]
    links = [attrs.get("href") or "" for tag, attrs in parser.seen if tag == "a"]
    assert all(link and "/" not in link for link in links)  # of a file beside the page, for the reader to open
    assert all(v is not None and v.startswith("data:image/png;base64,") for v in sources)
    assert "http" not in page
    assert "url(" not in page
    return parser
