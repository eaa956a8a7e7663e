"""Several devices, and several processes: a mesh, and functions placed on it."""
