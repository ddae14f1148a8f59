"""Trace ray paths in a furnished room or a scene file, and write them as `load_spectra` reads them."""
