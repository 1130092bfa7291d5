"""Make one self-contained page of a folder of results: text, figures, tables and pictures."""
