"""The pages: sections, texts, tables, JSON."""
