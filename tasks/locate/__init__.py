"""Positions from RSSI and spectra."""
