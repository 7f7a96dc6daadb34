"""The command line: translate and call once."""
