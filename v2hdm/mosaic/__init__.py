"""The ground from above: all images of a drive warped onto one plane, blended, measured and written.

Modules: :mod:`~v2hdm.mosaic.shots` (which ground a pixel shows), :mod:`~v2hdm.mosaic.shots` (images
and where they look), :mod:`~v2hdm.mosaic.blend` (the warp and the weighted mean, on kornia),
:mod:`~v2hdm.mosaic.sharpness` (how wide paint edges are), :mod:`~v2hdm.mosaic.result` (GeoTIFF and
picture), :mod:`~v2hdm.mosaic.sharpness` (before and after), :mod:`~v2hdm.mosaic.result` (from a
result folder to all of it).
"""
