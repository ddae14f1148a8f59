"""Hard cases, random scenes and tolerances for tests and benchmarks, and for people who add a backend."""
