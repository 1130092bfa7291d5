"""Make one self-contained HTML page of a folder of results, with text, figures, tables and images."""
