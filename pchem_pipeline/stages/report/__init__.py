"""Stage ``report``: the page, its numbers and its figures."""
