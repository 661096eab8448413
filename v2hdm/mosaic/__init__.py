"""The ground from above: all images of a drive warped onto one plane, blended, measured and written.

:mod:`~v2hdm.mosaic.shots` has the images and the raster on the ground, :mod:`~v2hdm.mosaic.blend` the warp
and the weighted mean, :mod:`~v2hdm.mosaic.sharpness` the width of paint edges and the comparison before and
after, :mod:`~v2hdm.mosaic.result` all of it from a result folder, and its files.
"""
