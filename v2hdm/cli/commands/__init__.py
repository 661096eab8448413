"""One file a command: ``v2hdm calibrate points`` is ``calibrate_points.py``, whose ``COMMAND`` declares it.

Files import what is heavy within their work, so that all of them are listed at once.
"""
