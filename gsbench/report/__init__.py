"""Make result tables and an HTML report from the records of training runs; this package does not need PyTorch."""
