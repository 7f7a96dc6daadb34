"""From frames to the vector of statistics that model and data are compared by."""
