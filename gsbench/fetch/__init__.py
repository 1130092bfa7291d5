"""Fetch data sets and weights that are published elsewhere, and put them where gsbench looks for them."""
