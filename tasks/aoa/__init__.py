"""Angle of arrival of the line of sight, from spatial spectra."""
