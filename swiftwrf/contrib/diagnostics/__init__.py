"""Checks of measured data: coordinate frames and the calibration of an array."""
