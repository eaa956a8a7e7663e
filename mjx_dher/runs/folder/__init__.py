"""A run on disk: its folder, fingerprint, metrics, checkpoints and locks."""
