"""Frames, conventions and basic geometry in numpy; every other package may import it.

:mod:`~v2hdm.geometry.tensors` is the part in torch and kornia: nothing that runs on the vehicle imports it.

Frames
    - ``map``: local east-north-up, metres, z up, the ground near z = 0, origin near the site (ROS
      REP-105). A geodetic origin, where there is one, matters to exports alone.
    - ``vehicle``: x forward, y left, z up; the origin on the ground under the rear axle (REP-103,
      ``base_link``). Roll, pitch and heading turn about x, y and z by the right-hand rule: a positive
      pitch lowers the nose, a positive heading turns left.
    - ``cam``: optical frame, z forward through the lens, x right, y down.
    - ``px``: image, u right, v down; the *centre* of the top-left pixel is (0, 0) (OpenCV's rule).
      ``pinhole_px`` are the same points with lens distortion removed, under the same intrinsic K.

Names
    - A transform is ``dst_from_src``, a 4 x 4 matrix that takes points of ``src`` to ``dst``; chains
      read by their touching names: ``cam_from_map = cam_from_vehicle @ vehicle_from_map``. The paper's
      [R_cb | t_cb] is ``cam_from_vehicle``, [R_wb | t_wb] ``map_from_vehicle``, H
      ``vehicle_from_pinhole_px``.
    - Points end in their frame (``corners_map``), scalars in their unit (``_px``, ``_m``, ``_rad``, ``_s``).
    - Index letters: ``i`` image, ``j`` marking, ``k`` corner observation.

Tangents
    - A tangent of SE(3) is (..., 6): **translation first (m), then rotation (rad)**.
    - Perturbations act from the **left**, ``exp(tangent) @ dst_from_src``: they are expressed in ``dst``.
      To first order, the translation part of a perturbed ``cam_from_vehicle`` is minus the displacement of
      the camera centre in camera axes, for any rotation part.
"""
