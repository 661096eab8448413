"""Images to markings and lanes.

:mod:`.network` finds paint, :mod:`.propose` pieces of it, :mod:`.fit` their corners in the :mod:`.patch` of
each, :mod:`.classifier` the probability of each, :mod:`.lanes` the lines.
:mod:`.detector` runs one image, :mod:`.batch` a drive, :mod:`.road` the loop of a robot.
"""
