"""The ground from above: all images of a drive warped onto one plane, blended, measured and written.

Modules: :mod:`~v2hdm.orthophoto.canvas` (which ground a pixel shows), :mod:`~v2hdm.orthophoto.shots` (images
and where they look), :mod:`~v2hdm.orthophoto.blend` (the warp and the weighted mean, on kornia),
:mod:`~v2hdm.orthophoto.sharpness` (how wide paint edges are), :mod:`~v2hdm.orthophoto.files` (GeoTIFF and
picture), :mod:`~v2hdm.orthophoto.comparison` (before and after), :mod:`~v2hdm.orthophoto.result` (from a
result folder to all of it).
"""
