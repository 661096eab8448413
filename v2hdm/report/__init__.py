"""Reports on a map: metrics against ground truth, figures, tables on the terminal, and the page."""
