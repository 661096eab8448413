"""COLMAP on the images of a rendered drive beside our result of the same drive, by the same truth.

``python -m tests.benchmarks.colmap_peer DRIVE RESULT [CAMERA]`` (extra ``bench``) gives COLMAP the images,
the exact intrinsics, and for each image the camera's centre by the recorded pose and the surveyed mounting
as a prior; DRIVE is a rendered drive in the cache, RESULT what ``v2hdm map`` made of it. It prints

- how many images were registered, the seconds, and the reprojection error, each of its own points;
- the camera's rotation and centre in the vehicle against the truth: of COLMAP the mean over the images;
- the corner RMSE on the ground when *perfect* tracks, the true corners by the true poses, are triangulated
  with the poses of either: what the geometry alone costs, with no detector in it.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from v2hdm.geometry.lens import has_distortion
from v2hdm.geometry.rigid import inverse
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.records import CameraInfo, Drive, FloatArray, Truth
from v2hdm.report.metrics import FULLY_VISIBLE, extrinsic_metrics, rms
from v2hdm.report.page.facts import read_facts

NEAREST_M, FARTHEST_M = 3.0, 16.0  # depth at which a corner is part of a track
OVERLAP = 8  # images that one is matched with


def main() -> None:
    """Compare, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("camera", nargs="?", default="front")
    arguments = parser.parse_args()
    drive = read_drive(arguments.drive)
    truth, rows = (
        read_truth(drive),
        [i for i, image in enumerate(drive.images) if image.camera == arguments.camera],
    )
    recorded = np.array([drive.images[i].map_from_vehicle for i in rows])
    with TemporaryDirectory() as scratch:
        began = time.perf_counter()
        cam_from_map_colmap, registered, points, error_px = colmap(
            drive, rows, arguments.camera, Path(scratch)
        )
        seconds = time.perf_counter() - began
    print(f"COLMAP: {registered} of {len(rows)} images, {points} points, {error_px:.2f} px, {seconds:.0f} s")
    facts = read_facts(arguments.result, drive)
    assert facts.route is not None
    at = [np.abs(facts.route.stamp_s - drive.images[i].stamp_s).argmin() for i in rows]
    mounting = facts.cameras[arguments.camera].calibration.cam_from_vehicle
    ours = mounting @ inverse(facts.route.flat[at])
    px, took = facts.best["reprojection_rmse_px"], sum(facts.metrics["seconds"].values())
    print(f"V2HDM: {len(rows)} images, {facts.best['markings']} markings, {px:.2f} px, {took:.0f} s")
    for name, cam_from_map, of in (("COLMAP", cam_from_map_colmap, None), ("V2HDM", ours, mounting)):
        is_registered = np.isfinite(cam_from_map[:, 0, 0])
        if not is_registered.any():
            print(f"{name}: no image was registered")
            continue
        mean = mean_pose(cam_from_map[is_registered] @ recorded[is_registered]) if of is None else of
        turned_deg, off_m = extrinsic_metrics(mean, truth.cam_from_vehicle[arguments.camera]).values()
        errors = corner_errors_m(truth, rows, cam_from_map, drive.cameras[arguments.camera].info)
        print(
            f"{name}: camera {turned_deg:.3f} deg, {100 * off_m:.1f} cm off; "
            f"perfect tracks of {len(errors)} corners {100 * rms(errors):.1f} cm RMSE, "
            f"median {100 * np.median(np.linalg.norm(errors, axis=1)):.1f} cm"
        )
    rmse_m = facts.best.get("corner_rmse_m", float("nan"))
    print(f"V2HDM's own map, from its detections: {100 * rmse_m:.1f} cm RMSE")


def colmap(drive: Drive, rows: list[int], camera: str, scratch: Path) -> tuple[FloatArray, int, int, float]:
    """``cam_from_map`` (I, 4, 4), nan where not registered; images, points, mean reprojection error."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    info, images = drive.cameras[camera].info, [drive.images[i] for i in rows]
    prior = drive.cameras[camera].centre_prior
    assert prior is not None, "the drive states no surveyed centre of its camera"
    assert info.distortion_model == "plumb_bob", info.distortion_model
    assert not any(info.distortion[4:]), "COLMAP's OPENCV has no k3"
    k = info.intrinsic
    of_lens = list(info.distortion[:4]) if has_distortion(info) else [0.0] * 4
    # COLMAP's pixels begin at the corner of the first one, ours at its centre.
    parameters = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *of_lens]
    database, folder = scratch / "database.db", images[0].path.parent
    reading = pycolmap.ImageReaderOptions(
        camera_model="OPENCV", camera_params=",".join(map(repr, map(float, parameters)))
    )
    pycolmap.extract_features(
        database, folder, [image.path.name for image in images], pycolmap.CameraMode.SINGLE, reading,
        device=pycolmap.Device.cpu,
    )  # fmt: skip
    with pycolmap.Database.open(database) as opened:
        for image in images:
            centre = (image.map_from_vehicle @ [*prior.centre_vehicle, 1.0])[:3]
            covariance = np.diag(prior.sigma_m**2 + drive.pose_noise.position_m**2)
            cartesian = pycolmap.PosePriorCoordinateSystem.CARTESIAN
            placed = pycolmap.PosePrior(
                corr_data_id=opened.read_image_with_name(image.path.name).data_id,
                position=centre,
                position_covariance=covariance,
                coordinate_system=cartesian,
            )
            opened.write_pose_prior(placed)
    pairing = pycolmap.SequentialPairingOptions(overlap=OVERLAP)
    pycolmap.match_sequential(database, pairing_options=pairing, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions(
        use_prior_position=True, ba_refine_focal_length=False, ba_refine_principal_point=False,
        ba_refine_extra_params=False, random_seed=1,
    )  # fmt: skip
    models = pycolmap.incremental_mapping(database, folder, scratch, options)
    out = np.full((len(rows), 4, 4), np.nan)
    if not models:
        return out, 0, 0, float("nan")
    best = max(models.values(), key=lambda model: model.num_reg_images())
    by_name = {image.name: image for image in best.images.values() if image.has_pose}
    for n, image in enumerate(images):
        if image.path.name in by_name:
            out[n] = np.vstack([by_name[image.path.name].cam_from_world().matrix(), [0, 0, 0, 1]])
    return out, len(by_name), best.num_points3D(), best.compute_mean_reprojection_error()


def mean_pose(poses: FloatArray) -> FloatArray:
    """The mean rotation and the mean centre of extrinsics (I, 4, 4)."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_matrix(poses[:, :3, :3]).mean().as_matrix()
    out[:3, 3] = -out[:3, :3] @ inverse(poses)[:, :3, 3].mean(axis=0)
    return out


def corner_errors_m(truth: Truth, rows: list[int], cam_from_map: FloatArray, info: CameraInfo) -> FloatArray:
    """Errors (N, 2) on the ground of true corners that two or more of the images see, triangulated."""
    true_cam = truth.cam_from_vehicle[info.name] @ inverse(truth.map_from_vehicle[rows])
    out = []
    for j, marking in enumerate(truth.map.markings):
        for corner in marking.corners_map:
            corner_cam = (true_cam @ [*corner, 0.0, 1.0])[:, :3]
            px = corner_cam @ info.intrinsic.T
            with np.errstate(divide="ignore", invalid="ignore"):
                px = px[:, :2] / px[:, 2:]
            good = (
                (corner_cam[:, 2] > NEAREST_M)
                & (corner_cam[:, 2] < FARTHEST_M)
                & np.isfinite(cam_from_map[:, 0, 0])
            )
            good &= ((px > 0) & (px < [info.width, info.height])).all(axis=1)
            good &= truth.visibility[rows, j] >= FULLY_VISIBLE
            if good.sum() >= 2:
                out.append(
                    triangulated(corner_cam[good, :2] / corner_cam[good, 2:], cam_from_map[good])[:2] - corner
                )
    return np.array(out).reshape(-1, 2)


def triangulated(rays: FloatArray, cam_from_map: FloatArray) -> FloatArray:
    """The point (3,) of least squared error in the images, from normalised coordinates (I, 2)."""
    rotation, shift, weight = cam_from_map[:, :3, :3], cam_from_map[:, :3, 3], np.ones(len(rays))
    point = np.zeros(3)
    for _ in range(10):  # linear, weighted by the inverse of the depth that it finds
        left = (rays[:, :, None] * rotation[:, 2:] - rotation[:, :2]) * weight[:, None, None]
        right = (shift[:, :2] - rays * shift[:, 2:]) * weight[:, None]
        point = np.linalg.lstsq(left.reshape(-1, 3), right.ravel(), rcond=None)[0]
        weight = 1.0 / (cam_from_map[:, 2, :3] @ point + shift[:, 2])
    return point


if __name__ == "__main__":
    main()
