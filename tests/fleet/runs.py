"""Run files of fleets."""


def written(folder, name, drive):
    """The run file of one drive, which may be too short for a map of centimetres."""
    path = folder / f"{name}.yaml"
    path.write_text(
        f"# @package _global_\nname: {name}\naccuracy_goal_cm: 100\nmosaic: false\ndrive:\n  path: {drive}\n"
    )
    return path
