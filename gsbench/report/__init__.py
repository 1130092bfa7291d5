"""Make tables and image strips from records, without torch."""
