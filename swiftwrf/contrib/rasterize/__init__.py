"""Fast backends of the rasterizer, named in `swiftwrf.rasterize.operators`."""
