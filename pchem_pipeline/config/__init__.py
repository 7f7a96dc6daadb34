"""The YAML tree of a run: sections, loading, writing, and checks across stages."""
