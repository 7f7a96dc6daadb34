"""Who does the work: serial, threads, processes or a cluster, behind one small interface."""
