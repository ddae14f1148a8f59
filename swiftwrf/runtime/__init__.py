"""Files, registries, threads and progress: what every package needs and no formula of the model."""
