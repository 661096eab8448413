"""Words on the ground, read: patches of the images that show them best, a network, and its readings weighed.

:mod:`~v2hdm.words.recogniser` is the network of the extra ``text``, :mod:`~v2hdm.words.patches` cuts words
out of images, upright in each of four directions, :mod:`~v2hdm.words.reading` weighs all readings of a word.
"""
