"""Executors behind one small interface: serial, threads, processes, a dask cluster."""
