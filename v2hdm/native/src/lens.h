// Lenses; twin of v2hdm.geometry.lens and of camera.RoadCamera.undistort.
#pragma once

namespace v2hdm {

// A table of camera.Lens; its values are null where nothing is distorted.
struct LensTable {
    const double* values;
    int width, height;
    double step_px;

    // A recorded pixel as a pinhole pixel; camera.RoadCamera.undistort.
    void undistort(double u, double v, double pinhole[2]) const;
};

// Intrinsics and the eight coefficients of OpenCV's calib3d, in its order.
struct BrownConrady {
    double fx, fy, cx, cy, skew;
    double k1, k2, p1, p2, k3, k4, k5, k6;

    // A pinhole pixel as a recorded pixel, in place.
    void distort(double px[2]) const;
};

}  // namespace v2hdm
