"""Measurements of the rollout engine: ``python -m benchmarks [NAME…]``."""
