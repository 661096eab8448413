"""Markings with four corners.

:mod:`.blobs` are pieces of paint, :mod:`.propose` puts quadrilaterals around them, :mod:`.outline` draws
symbols. :mod:`.patch` has an image's pixels, :mod:`.lattice` those about a marking's sides. :mod:`.coverage`
says how much of a pixel a marking covers, :mod:`.robust` how much the pixel counts, :mod:`.state` takes the
steps of a :mod:`.fit`.
"""
