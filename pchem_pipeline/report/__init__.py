"""Figures, the HTML report and ``report.json``: arrays in, pages out; the only home of matplotlib."""
