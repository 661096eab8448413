"""The engine ``numba``: kernels, compiled when they are first called, for what is done to every observation.

All that is particular to a model, such as states, clocks, drifts and extrinsics, acts through the table of
pairs, so that kernels know none of it.
"""
