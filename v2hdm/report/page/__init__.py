"""The report of a run: one page that opens in any browser, offline, with the map in it.

``facts`` reads a result folder and, where it is at hand, the drive; ``tables``, ``charts``, ``layers`` and
``pictures`` make of them what the page shows; ``document`` puts it together and ``write`` fills the
templates. Everything that the page says stands in a file of the folder or comes from the drive's images.
"""
