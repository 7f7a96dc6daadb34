"""What the command line does beyond stages: new runs, append, compare, export, figures, view, plan."""
