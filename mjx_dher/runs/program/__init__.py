"""A compiled training program, and the loop that calls it."""
