"""What a saved model says of new measurements or positions: directions, positions, spectra or RSSI."""
