"""Dashes of an OpenDRIVE file whose places can be worked out by hand."""

import numpy as np
import pytest

from v2hdm.asbuilt.lane_marks import dashes_of
from v2hdm.errors import MapFileError

LINE = '<line length="2" space="4" tOffset="0" sOffset="1"/>'


def mark(kind="broken", line=LINE):
    inner = f'<type name="{kind}" width="0.2">{line}</type>' if line else ""
    return f'<roadMark sOffset="0" type="{kind}" width="0.2">{inner}</roadMark>'


SOLID = mark("solid", "")


def road(path, right, middle=SOLID, offset=0.0, shape="<line/>", section_m=0.0):
    path.write_text(
        f'<OpenDRIVE><road id="7" length="20"><planView><geometry s="0" x="100" y="50" hdg="0" length="20">'
        f'{shape}</geometry></planView><lanes><laneOffset s="0" a="{offset}" b="0" c="0" d="0"/>'
        f'<laneSection s="{section_m}"><center><lane id="0">{middle}</lane></center><right>{right}</right>'
        "</laneSection></lanes></road></OpenDRIVE>"
    )
    return path


def lane(number, width_m, what, slope=0.0):
    return f'<lane id="-{number}"><width sOffset="0" a="{width_m}" b="{slope}" c="0" d="0"/>{what}</lane>'


def test_dashes_lie_along_the_outer_border_of_their_lane(tmp_path):
    solid = lane(1, 3.0, mark("solid", ""))
    dashes = dashes_of(road(tmp_path / "a.xodr", solid + lane(2, 2.5, mark())))
    # From 1 m on every 6 m, 3 + 2.5 m to the right: the last is cut by the road's end.
    assert [dash[:, 0].min() for dash in dashes] == pytest.approx([101.0, 107.0, 113.0, 119.0])
    assert [np.ptp(dash[:, 0]) for dash in dashes] == pytest.approx([2.0, 2.0, 2.0, 1.0])
    for dash in dashes:
        assert dash[:, 1] == pytest.approx([44.4, 44.4, 44.6, 44.6])


def test_a_lane_that_widens_and_an_offset_of_the_middle_move_them(tmp_path):
    first, *_ = dashes_of(road(tmp_path / "a.xodr", lane(1, 3.0, mark(), slope=0.1), offset=0.5))
    # At 1 m the lane is 3.1 m wide, at 3 m 3.3 m.
    assert first[[0, 1], 1] == pytest.approx([50.5 - 3.1 - 0.1, 50.5 - 3.3 - 0.1])


def test_the_middle_mark_follows_a_bend(tmp_path):
    shape = '<arc curvature="0.1"/>'
    _, second, *_ = dashes_of(road(tmp_path / "a.xodr", lane(1, 3.0, mark("none", "")), mark(), shape=shape))
    centre = np.array([100.0, 60.0])
    assert np.linalg.norm(second - centre, axis=1) == pytest.approx([10.1, 10.1, 9.9, 9.9], abs=1e-4)


def test_a_mark_that_states_no_line_has_dashes_of_three_metres(tmp_path):
    dashes = dashes_of(road(tmp_path / "a.xodr", lane(1, 3.0, mark("broken", ""))))
    assert [np.ptp(dash[:, 0]) for dash in dashes] == pytest.approx([3.0, 3.0, 3.0, 2.0])


@pytest.mark.parametrize(
    ("right", "says"),
    [
        (lane(1, 3.0, mark(line='<line length="0" space="4"/>')), "dashes of 0 m and gaps of 4 m"),
        (lane(1, 3.0, mark(line='<line space="4"/>')), "road 7: a line has no length"),
        (lane(1, "wide", mark()), "road 7: could not convert string to float"),
    ],
)
def test_a_damaged_mark_is_one_line(right, says, tmp_path):
    path = road(tmp_path / "a.xodr", right)
    with pytest.raises(MapFileError, match=says) as refused:
        dashes_of(path)
    assert str(path) in str(refused.value)
