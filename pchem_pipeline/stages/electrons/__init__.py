"""Stage ``electrons``: the stack of electron numbers."""
