// Lenses; twin of v2hdm.geometry.lens and of camera.RoadCamera.undistort.
#pragma once

#include <algorithm>
#include <cstddef>

namespace v2hdm {

// A table of camera.Lens; its values are null where nothing is distorted.
struct LensTable {
    const double* values;  // (height, width, 2, 4)
    int width, height;
    double step_px;

    // A recorded pixel as a pinhole pixel; camera.RoadCamera.undistort.
    void undistort(double u, double v, double pinhole[2]) const {
        pinhole[0] = u;
        pinhole[1] = v;
        if (values == nullptr) return;
        const double across = u / step_px, down = v / step_px;
        // Not-a-number, or farther away than whole numbers reach, is read at the border.
        const auto place = [](double at, int last) { return at > 0 ? static_cast<int>(std::min<double>(at, last)) : 0; };
        const int column = place(across, width - 1), row = place(down, height - 1);
        const double right = across - column, below = down - row;
        const double* cell = values + 8 * (static_cast<size_t>(row) * width + column);
        for (int axis = 0; axis < 2; ++axis, cell += 4) {
            pinhole[axis] = cell[0] + cell[1] * right + (cell[2] + cell[3] * right) * below;
        }
    }
};

// Intrinsics and the eight coefficients of OpenCV's calib3d, in its order.
struct BrownConrady {
    double fx, fy, cx, cy, skew;
    double k1, k2, p1, p2, k3, k4, k5, k6;

    // A pinhole pixel as a recorded pixel, in place.
    void distort(double px[2]) const;
};

}  // namespace v2hdm
