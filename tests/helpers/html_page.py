"""Pages of a report as their readers get them: tags, words, and that nothing is loaded or run."""

import re
from collections.abc import Iterator
from html.parser import HTMLParser

#: HTML, a script, a formula and a template, for all places with words of others
HOSTILE = (
    '<script>alert("x")</script><img src=http://evil.example/x onerror=alert(1)>"\'{{ 7*7 }} '
    "$x^{ \u4e2d\U0001f600"
)


class Page(HTMLParser):
    """Every tag with its attributes, the text, and the style."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.style = ""
        self._in_style = False
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._in_style = tag == "style"

    def handle_data(self, data: str) -> None:
        if self._in_style:
            self.style += data
            self._in_style = False
        else:
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words)).replace("\xa0", " ")

    def of(self, tag: str) -> Iterator[dict[str, str | None]]:
        return (attributes for name, attributes in self.tags if name == tag)


def harmless(html: str) -> Page:
    """Return a page that loads nothing, runs nothing but its own scripts, and whose links lead somewhere."""
    page = Page(html)
    for tag, attributes in page.tags:
        assert tag not in ("link", "iframe", "object", "embed", "base", "form")
        assert tag != "script" or set(attributes) <= {"type", "id"}  # its policy: test_report_html.py
        for name, value in attributes.items():
            assert not name.startswith("on")
            if name in ("src", "srcset", "href", "data", "poster", "action", "background"):
                beside = (tag, value) == ("a", "discrepancy.html")
                assert beside or str(value).startswith(("data:image/", "#")), (tag, name)
    assert "url(" not in page.style
    assert "@import" not in page.style
    ids = [a["id"] for _, a in page.tags if a.get("id")]
    assert len(ids) == len(set(ids))
    assert {str(a["href"])[1:] for a in page.of("a") if a["href"] != "discrepancy.html"} <= set(ids)
    return page
