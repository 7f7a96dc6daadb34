"""What a stage is, and what runs stages: fingerprints, runner, session, progress, signals."""
