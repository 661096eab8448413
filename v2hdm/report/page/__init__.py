"""The report of a run: one self-contained page with the map, for any browser, offline.

``facts`` reads a result folder and, if available, the drive; ``tables``, ``charts``, ``layers`` and
``pictures`` prepare the content; ``document`` assembles it and fills the templates. All content comes from
files of the folder or the drive's images.
"""
