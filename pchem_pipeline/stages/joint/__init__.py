"""Stage ``joint``: several exposures of the same pixels fitted together."""
