"""Show a model as a film, as files for other programs, and in a browser."""
