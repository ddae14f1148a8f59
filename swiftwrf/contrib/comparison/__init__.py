"""Comparisons of all methods on held-out rows, and the baselines that they compare."""
