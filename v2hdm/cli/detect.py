"""``v2hdm detect SOURCE``: one JSON object per image, percentiles of the latency at the end on stderr.

It needs the base install only (numpy, opencv, onnxruntime, PyYAML). docs/detect.md describes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import parser_of


def run(arguments: Sequence[str]) -> None:
    """Detect in every image of a source."""
    parser = parser_of("detect")
    parser.add_argument(
        "source", help="an image, a folder of images, a drive folder, a video file, or a camera's index"
    )
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="the camera's calibration: gives metres; or its intrinsics, as written by Kalibr, OpenCV, ROS "
        "or COLMAP",
    )
    parser.add_argument("--camera-name", metavar="NAME", help="which camera of intrinsics that hold several")
    parser.add_argument(
        "--mounting",
        type=float,
        nargs=3,
        metavar=("HEIGHT_M", "PITCH_DEG", "FOV_DEG"),
        help="without a calibration: about how high the camera is, how far it looks down, its horizontal "
        "field of view (default: 1.6 5 60); intrinsics of --camera overrule the last",
    )
    parser.add_argument(
        "--linear", action="store_true", help="grey values are proportional to light, not sRGB"
    )
    parser.add_argument("--model", help="ONNX file of the detector (default: the one that is shipped)")
    parser.add_argument("--threads", type=int, default=1, help="threads of the network (default: 1)")
    parser.add_argument("--limit", type=int, metavar="N", help="stop after N images")
    parser.add_argument("--output", type=Path, help="file for the JSON lines (default: stdout)")
    parser.add_argument(
        "--draw", type=Path, metavar="DIR", help="folder for the images with detections drawn"
    )
    parsed = parser.parse_args(arguments)
    from v2hdm.cli.detect_files import detect_to_files

    detect_to_files(parsed)
