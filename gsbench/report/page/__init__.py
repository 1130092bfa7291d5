"""Make one self-contained HTML report of a folder of run records, with text, figures, tables and images."""
