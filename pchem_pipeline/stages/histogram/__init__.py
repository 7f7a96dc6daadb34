"""Stage ``histogram``: counts and summaries of every pixel in one pass over the frames."""
