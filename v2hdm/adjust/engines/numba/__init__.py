"""The engine ``numba``: kernels, compiled on first use, for all work per observation.

States, clocks, drifts and extrinsics act through the table of pairs, so that kernels are independent of the
model.
"""
