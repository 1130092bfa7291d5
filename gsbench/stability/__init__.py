"""Measure how exact float32 images are: each view of a model is rendered in float64 too, with a bound on the error."""
