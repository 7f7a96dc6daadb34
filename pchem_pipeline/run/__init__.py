"""What a stage is and is given: its declaration, context, fingerprint, model, progress, signals."""
