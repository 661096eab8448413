"""An incremental map on disk: stop, save and go on later as if nothing had happened."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v2hdm.adjust.incremental import IncrementalMap, RigPrior, Settled, State
from v2hdm.adjust.marking_fit import MarkingObservations
from v2hdm.adjust.pose_errors import Noise
from v2hdm.errors import AdjustError
from v2hdm.files import whole_file
from v2hdm.records import FloatArray, IntArray

_OBSERVED = tuple(field.name for field in fields(MarkingObservations))
# What markings have in different numbers, flattened end to end; the rest is stacked.
_RAGGED = ("corners_map", "gain", "covariance_m2", "frame_state", "influence")
_STACKED = ("at", "information", "vector", "state_squared")


def save_map(grown: IncrementalMap, path: Path) -> None:
    """Write ``grown`` to ``path`` (an ``.npz`` archive), all of it or nothing."""
    settled = list(grown.state.settled.values())
    arrays = {f"prior_{name}": np.asarray(value) for name, value in vars(grown.prior).items()}
    arrays |= {f"noise_{name}": np.asarray(value) for name, value in vars(grown.noise).items()}
    arrays |= {
        "linearised_count": np.asarray(grown.state.linearised_count),
        "tangents": grown.state.tangents,
        "information": grown.state.information,
        "vector": grown.state.vector,
        "markings": np.array(list(grown.state.settled), dtype=np.int64),
        "observation_counts": np.array([len(one.observations.camera) for one in settled], dtype=np.int64),
        "corner_counts": np.array([len(one.corners_map) for one in settled], dtype=np.int64),
        "frame_counts": np.array([len(one.frame_state) for one in settled], dtype=np.int64),
    }
    arrays |= {
        f"seen_{name}": _joined(getattr(one.observations, name) for one in settled) for name in _OBSERVED
    }
    arrays |= {
        f"settled_{name}": _joined(getattr(one, name) for one in settled) for name in _RAGGED + _STACKED
    }
    with whole_file(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def load_map(path: Path) -> IncrementalMap:
    """Read what :func:`save_map` wrote; the map goes on bit for bit as the saved one would have.

    Raises:
        AdjustError: there is no such file, or it is none of these.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return _restored(dict(archive))
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        raise AdjustError(
            f"{path}: no saved map can be read here; start without one or name another"
        ) from None


def _restored(arrays: dict[str, FloatArray]) -> IncrementalMap:
    prior = RigPrior(
        intrinsic=arrays["prior_intrinsic"],
        cam_from_vehicle=arrays["prior_cam_from_vehicle"],
        centre_vehicle=arrays["prior_centre_vehicle"],
        centre_sigma_m=arrays["prior_centre_sigma_m"],
        rotation_sigma_rad=float(arrays["prior_rotation_sigma_rad"]),
    )
    settled = dict(zip(arrays["markings"].tolist(), _settled(arrays), strict=True))
    return IncrementalMap(
        prior,
        Noise(
            arrays["noise_pose_sigma"],
            float(arrays["noise_cauchy_scale"]),
            arrays["noise_drift_sigma"],
            arrays["noise_drift_over_m"],
        ),
        State(
            settled,
            int(arrays["linearised_count"]),
            arrays["tangents"],
            arrays["information"],
            arrays["vector"],
        ),
    )


def _shapes(corners: int, frames: int, unknowns: int) -> dict[str, tuple[int, int]]:
    """Shapes of what markings have in different numbers."""
    return {
        "corners_map": (corners, 2),
        "gain": (2 * corners, unknowns),
        "covariance_m2": (2 * corners, 2 * corners),
        "frame_state": (frames, 6),
        "influence": (unknowns, 6 * frames),
    }


def _settled(arrays: dict[str, FloatArray]) -> list[Settled]:
    """The markings, cut out of the flat arrays."""
    unknowns, count = len(arrays["tangents"]), len(arrays["markings"])
    numbers = zip(arrays["corner_counts"].tolist(), arrays["frame_counts"].tolist(), strict=True)
    shapes = [_shapes(corners, frames, unknowns) for corners, frames in numbers]
    own = {name: _cut(arrays[f"settled_{name}"], [shape[name] for shape in shapes]) for name in _RAGGED}
    by_tangent = arrays["settled_at"].reshape(count, unknowns)
    information = arrays["settled_information"].reshape(count, unknowns, unknowns)
    vector = arrays["settled_vector"].reshape(count, unknowns)
    observed = arrays["observation_counts"].tolist()
    seen: dict[str, list[Any]] = {
        name: _cut(arrays[f"seen_{name}"], [(rows, *_SHAPES[name]) for rows in observed])
        for name in _OBSERVED
    }
    return [
        Settled(
            observations=MarkingObservations(**{name: seen[name][m] for name in _OBSERVED}),
            at=by_tangent[m],
            information=information[m],
            vector=vector[m],
            state_squared=float(arrays["settled_state_squared"][m]),
            **{name: parts[m] for name, parts in own.items()},
        )
        for m in range(count)
    ]


_SHAPES: dict[str, tuple[int, ...]] = {
    "camera": (),
    "corner": (),
    "frame": (),
    "travelled_m": (),
    "vehicle_from_map": (4, 4),
    "pinhole_px": (2,),
    "covariance_px": (2, 2),
}


def _joined(parts: Iterable[FloatArray | IntArray]) -> NDArray[Any]:
    """All values of all parts, end to end."""
    flat = [np.ravel(part) for part in parts]
    return np.concatenate(flat) if flat else np.zeros(0)


def _cut(flat: FloatArray, shapes: Sequence[tuple[int, ...]]) -> list[FloatArray]:
    """Inverse of :func:`_joined`, given the shapes of the parts."""
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes], dtype=np.int64)
    parts = np.split(flat, ends[:-1]) if len(shapes) else []
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]
