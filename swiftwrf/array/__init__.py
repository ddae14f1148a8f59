"""Directions, element positions, beamforming and poses of an antenna array."""
