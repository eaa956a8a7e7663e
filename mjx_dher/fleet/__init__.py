"""Sweeps on a Ray cluster: chunks of runs, the worker that trains them, the cluster and the driver."""
