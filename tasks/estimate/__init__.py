"""Directions from spectra, by an estimator that a run of tasks.aoa trained."""
