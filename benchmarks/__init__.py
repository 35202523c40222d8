"""Measurements, never tests: `python -m benchmarks` for speed, `python -m benchmarks.certificates` for certificates."""
