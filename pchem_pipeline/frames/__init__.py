"""Readers and writers of camera formats behind one interface; ready-made histograms.

Entry points: `pchem_pipeline.frames.open.open_frames`, `frames.resolve.resolve_files`,
`frames.histogram_files.read_histograms`, `frames.writing.write_frames`; the settings in `frames.settings`.
"""
