"""Download data sets and weights that others publish, and put them where gsbench finds them."""
