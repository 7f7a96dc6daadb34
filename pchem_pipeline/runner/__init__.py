"""What runs stages: one command from start to end (session), one stage brought up to date (execute)."""
