"""The run's store: one zarr root with arrays, tile markers, stage records and a lock."""
