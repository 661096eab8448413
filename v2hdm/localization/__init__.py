"""Where the vehicle is, from a map's markings seen by its cameras.

:mod:`.run` follows a recorded drive by :mod:`.filter`. :mod:`.localizer` follows a vehicle as it drives: it
searches for :mod:`.places`, pairs what is :mod:`.seeing` with :mod:`.paint` by :mod:`.joint` compatibility,
holds a :mod:`.belief` between samples of :mod:`.motion`, and watches the :mod:`.agreement` of all;
:mod:`.live` and :mod:`.stream` are its command.
"""
