"""One report over several finished runs of one task."""
