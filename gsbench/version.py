"""Say which version of gsbench this is, in the one place that all others read."""

__version__ = "0.2.0"  # pyproject.toml reads it here, and a test holds CITATION.cff to it
