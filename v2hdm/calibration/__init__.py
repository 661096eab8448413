"""A camera's pre-calibration from surveyed ground points: mounting, IPM, and how well both are known.

Modules: :mod:`~v2hdm.calibration.points` (the table of points), :mod:`~v2hdm.calibration.likelihood`
(what the points say of a mounting), :mod:`~v2hdm.calibration.fit` (the most likely mounting),
:mod:`~v2hdm.calibration.readings` (what else the table could mean),
:mod:`~v2hdm.calibration.findings`, :mod:`~v2hdm.calibration.picture`,
:mod:`~v2hdm.calibration.run`.
"""
