"""One module a stage; each reads and writes the store through the same contract."""
