"""Measure a run: the quality of its images, its speed, its curve, and the record that keeps them."""
