"""Several devices and processes: a mesh, and functions placed on it."""
