"""Measurements of speed; run each from the repository, e.g. `python -m benchmarks.backbone`."""
