"""Training runs: folders, checkpoints, logs and the driver. Empty, so that policies load with NumPy alone."""
