"""Images to markings and lanes.

:mod:`.network` finds paint, :mod:`.quads` the pieces of it and their corners, :mod:`.classifier` the
probability of each by its :mod:`.evidence`, its :mod:`.hidden` ends and its :mod:`.company`, :mod:`.lanes`
the lines. :mod:`.detector` runs one image, :mod:`.batch` a drive, :mod:`.road` the loop of a robot.
"""
