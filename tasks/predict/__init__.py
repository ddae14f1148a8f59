"""Answers of a saved model to new measurements or positions: directions, positions, spectra or RSSI."""
