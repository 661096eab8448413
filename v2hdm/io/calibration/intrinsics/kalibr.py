"""Kalibr: ``camchain.yaml``, a camera under each of cam0, cam1, ..."""

from __future__ import annotations

from v2hdm.errors import DriveError
from v2hdm.io.calibration.intrinsics.document import Document
from v2hdm.io.calibration.intrinsics.lenses import brown_conrady, checked, complete, matrix
from v2hdm.io.fields import take_size_px
from v2hdm.records import CameraInfo
from v2hdm.store.files import take_array, take_text

_MODELS = {
    "omni": "omnidirectional (omni)",
    "ds": "double sphere (ds)",
    "eucm": "extended unified (eucm)",
}
"""Projections of Kalibr's that are none of ours."""

_EQUIDISTANT = ("equidistant", "equi")
_NEEDED = ("camera_model", "intrinsics", "distortion_model", "resolution")


def is_kalibr(document: Document) -> bool:
    """Whether some entry at the top of the file is a camera of Kalibr's."""
    return bool(kalibr_names(document))


def kalibr_names(document: Document) -> list[str]:
    """The cameras of the chain."""
    return [
        str(name)
        for name, entry in document.entries.items()
        if isinstance(entry, dict) and {"camera_model", "intrinsics"} & set(entry)
    ]


def read_kalibr(document: Document, name: str) -> CameraInfo:
    """The intrinsics of one camera of the chain.

    Raises:
        DriveError: an entry is missing or damaged, or the lens is none of ours.
    """
    where, entry = f"{document.path}: {name}", document.entries[name]
    for key in _NEEDED:
        if key not in entry:
            raise DriveError(f"{where}: missing key '{key}'; take the camchain that Kalibr wrote")
    projection = take_text(entry["camera_model"], f"{where}, camera_model", DriveError)
    if projection != "pinhole":
        raise DriveError(
            f"{where}: its lens is {_MODELS.get(projection, repr(projection))}, which is beyond our models; "
            "calibrate with pinhole-radtan or pinhole-equi"
        )
    model = take_text(entry["distortion_model"], f"{where}, distortion_model", DriveError)
    given = entry.get("distortion_coeffs")
    values: list[float] = []
    if given not in (None, []):
        values = take_array(given, (-1,), f"{where}, distortion_coeffs", DriveError).tolist()
    if model in _EQUIDISTANT:
        if len(values) != 4:
            raise DriveError(f"{where}, distortion_coeffs: {model} has 4 coefficients, got {len(values)}")
        lens = ("equidistant", complete("equidistant", values))
    elif model in ("radtan", "none"):
        lens = brown_conrady([] if model == "none" else values, f"{where}, distortion_coeffs")
    else:
        raise DriveError(
            f"{where}: its lens is '{model}', which is beyond our models; calibrate with pinhole-radtan or "
            "pinhole-equi"
        )
    size = take_array(entry["resolution"], (2,), f"{where}, resolution", DriveError)
    width, height = (take_size_px(value, f"{where}, resolution", DriveError) for value in size.tolist())
    numbers = take_array(entry["intrinsics"], (4,), f"{where}, intrinsics", DriveError)
    return checked(CameraInfo(name, width, height, matrix(*numbers.tolist()), *lens), where)
