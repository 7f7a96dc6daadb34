"""Fisher and observed information: standard errors and bounds."""
