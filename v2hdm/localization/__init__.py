"""Where the vehicle is, from a map's markings seen by its cameras.

:mod:`.run` follows a recorded drive by :mod:`.filter`. :mod:`.localizer` follows a vehicle as it drives: it
searches for :mod:`.places`, by :mod:`.words` too, pairs what is :mod:`.seeing` with :mod:`.paint` by
:mod:`.joint` compatibility, takes :mod:`.lines` and :mod:`.areas` beside (:mod:`.observation`), holds a
:mod:`.belief` between samples of :mod:`.motion`, and watches the :mod:`.agreement` of all. It says in which
:mod:`.regions` of the next image to look. :mod:`.live` and :mod:`.stream` are its command.
"""
