"""Look at a model: as a film, as files that other programs open, and in a browser."""
