"""Many runs: the grid, the tables, the comparison and its pictures."""
