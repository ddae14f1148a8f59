"""Field models: each predicts spectra at any position."""
