"""What a run has made, kept on disk so that the next one need not make it again.

An entry is a file that is named after a digest of all that it was made from, written whole or not at all, and
checked by its checksum whenever it is read: a damaged one counts as absent. :mod:`v2hdm.store.cache.codec` says
what can be kept; :mod:`v2hdm.store.cache.store` where; :mod:`v2hdm.store.cache.room` hands out what is there and
makes what is not; :mod:`v2hdm.store.cache.pruning` keeps the whole below its limit.
"""
