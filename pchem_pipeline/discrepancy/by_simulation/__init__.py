"""Effects named by simulating them: fingerprints, replicates, rounds."""
