"""Download published data sets and network weights to the folders in which gsbench looks for them."""
