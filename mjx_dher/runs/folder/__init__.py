"""A run on disk: folder, fingerprint, metrics, checkpoints and locks."""
