"""What tests and benchmarks share: hard cases, random scenes, tolerances. For those who change the code or add a backend."""
