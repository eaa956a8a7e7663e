"""Runs on disk: folders, checkpoints, logs, and the driver that trains. Kept empty: a policy loads where only NumPy is."""
