"""From about where to corners below the pixel, each with a covariance, and what speaks for them."""
