"""Sweeps: the grid, tables, comparison and figures of many runs."""
