"""Define the version of gsbench, the only place where it is written in the code."""

__version__ = "0.3.0"  # pyproject.toml reads this line, and a test compares CITATION.cff with it
