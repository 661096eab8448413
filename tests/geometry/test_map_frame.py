"""The text of a map's frame: systems with national datums are moved to it, satellite datums are not."""

import pyproj
import pytest

from v2hdm.geometry.geodetic import crs_of
from v2hdm.records import GeodeticOrigin


@pytest.mark.parametrize("datum", ["WGS84", "ETRS89"])
def test_a_background_of_a_national_datum_is_moved_to_the_map(datum):
    """Gauss-Krueger zone 3 on DHDN differs from ETRS89 by 120 m and more in Hamburg."""
    origin = GeodeticOrigin(53.54, 9.93, 12.0, datum)
    satellite = pyproj.Transformer.from_crs("EPSG:31467", "EPSG:25832", always_xy=True)
    to_grid = pyproj.Transformer.from_crs("EPSG:25832", crs_of(origin), always_xy=True)
    place = (3561700.0, 5934700.0)
    by_satellite = to_grid.transform(*satellite.transform(*place))
    direct = pyproj.Transformer.from_crs("EPSG:31467", crs_of(origin), always_xy=True).transform(*place)
    assert direct == pytest.approx(by_satellite, abs=3.0)  # the two transformations that PROJ has at hand
