"""Judging a map: metrics against ground truth, figures and the table that ends a run."""
