"""The frames before anything is asked: their split, the parts that differ, the evidence."""
