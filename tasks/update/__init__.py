"""Update of a fitted model with new measurements, and detection of changes."""
