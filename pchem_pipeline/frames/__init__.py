"""Readers and writers of camera formats behind one interface; ready-made histograms.

The doors: `pchem_pipeline.frames.open.open_frames` and `inspect_files`, `frames.resolve.resolve_files`,
`frames.histograms.read_histograms`, `frames.writing.write_frames`; the settings in `frames.settings`.
"""
