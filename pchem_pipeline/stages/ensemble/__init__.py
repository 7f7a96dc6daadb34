"""Stage ``ensemble``: the sensor as a whole, predicted from its maps."""
