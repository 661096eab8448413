"""A camera's pre-calibration from surveyed ground points: mounting, IPM, and how well both are known.

Modules: :mod:`~v2hdm.precalibration.points` (the table of points), :mod:`~v2hdm.precalibration.likelihood`
(what the points say of a mounting), :mod:`~v2hdm.precalibration.fit` (the most likely mounting),
:mod:`~v2hdm.precalibration.readings` (what else the table could mean),
:mod:`~v2hdm.precalibration.findings`, :mod:`~v2hdm.precalibration.picture`,
:mod:`~v2hdm.precalibration.run`.
"""
