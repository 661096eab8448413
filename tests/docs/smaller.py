"""Settings that are added to a documented command so that it ends in seconds on one core."""

SMALL_PORT = (
    "simulate.seed=11", "simulate.route.pieces=[[12.0,0.0],[12.0,55.0],[4.0,0.0]]",
    "simulate.route.image_spacing_m=3.0", "~simulate.cameras.rear", "simulate.cameras.front.width=640",
    "simulate.cameras.front.height=360", "simulate.cameras.front.focal_px=450.0",
    "simulate.yard.parked_trucks=0", "simulate.yard.barriers=0", "simulate.yard.shadow_strips=1",
)  # fmt: skip
"""28 m of a port in 9 images, one camera, half its pixels, little in the way."""


def smaller(arguments: list[str]) -> list[str]:
    """The arguments of ``v2hdm`` with what makes the command small."""
    name, options = arguments[0], arguments[1:]
    if (name in ("check", "localize") and "--list-topics" not in options) or options[:1] == ["ground"]:
        return [*arguments, "--workers", "1"]
    if name not in ("map", "simulate") or "--cfg=job" in options:
        return arguments
    ports = [option for option in options if option.startswith("+run=port")]
    small = [*(SMALL_PORT if ports else ()), "workers=1"]
    if name == "map" and options != ["+run=port2"]:  # that of `make map` shows the mosaic, once for all
        small.append("mosaic=false")
    if any(argument.startswith("drive.path=bench/") for argument in options):
        small.append("drive.limit=40")
    return [*arguments, *small]
