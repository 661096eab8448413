"""The ground from above: all images of a drive warped onto one plane, blended and written.

:mod:`~v2hdm.mosaic.blend` has the images, the raster on the ground, the warp and the weighted mean,
:mod:`~v2hdm.mosaic.result` the comparison before and after, and all of it from a result folder, with its
files.
"""
