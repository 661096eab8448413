"""Engines that evaluate and linearise the model: autograd of kornia, or kernels compiled by numba."""
