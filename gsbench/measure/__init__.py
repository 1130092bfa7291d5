"""Measure quality, speed and memory of a run, and keep the results in its record."""
