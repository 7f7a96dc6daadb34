"""Stage ``methods``: other characterisation methods on the same pixels."""
