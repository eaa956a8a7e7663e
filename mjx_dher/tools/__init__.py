"""Tools for trained policies and for this machine. Empty, so that `transfer` runs with NumPy alone."""
