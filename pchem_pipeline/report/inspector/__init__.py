"""The pixel inspector of the report."""
