"""Make tables and an HTML page from the records of runs; this package needs no torch."""
