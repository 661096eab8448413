"""A camera's pre-calibration from surveyed ground points: mounting, IPM, and how well both are known.

Modules: :mod:`~v2hdm.calibration.points` (the table of points), :mod:`~v2hdm.calibration.fit`
(what the points say of a mounting), :mod:`~v2hdm.calibration.fit` (the most likely mounting),
:mod:`~v2hdm.calibration.from_points` (what else the table could mean),
:mod:`~v2hdm.calibration.residuals`, :mod:`~v2hdm.calibration.picture`,
:mod:`~v2hdm.calibration.from_points`.
"""
