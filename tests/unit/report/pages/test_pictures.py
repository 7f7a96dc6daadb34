"""Figures as the data URLs that a page embeds."""

from urllib.parse import quote

from pchem_pipeline.report.pages.pictures import escaped


def test_a_drawing_is_escaped_as_a_url_wants_it():
    every = bytes(range(256)) * 2 + b'<path d="M 1.5%20,2" style="fill:#12345%"/>'
    assert escaped(every) == quote(every, safe=" !$()*+,-./:;=?@[]^_`{|}~")
