"""Places that are named by URL, as object stores are: what is kept there, who writes there, results.

A put replaces an object at once or not at all, and an object can be created once; nothing else is asked of a
store. :mod:`v2hdm.store.objects.bucket` reads and writes; :mod:`v2hdm.store.objects.lease` keeps two processes from one
place; :mod:`v2hdm.store.objects.results` puts results there so that no reader takes half of one for a whole.
"""
