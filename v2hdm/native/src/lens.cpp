#include "lens.h"

#include <algorithm>
#include <cstddef>

namespace v2hdm {

void LensTable::undistort(double u, double v, double pinhole[2]) const {
    pinhole[0] = u;
    pinhole[1] = v;
    if (values == nullptr) return;
    const double across = u / step_px, down = v / step_px;
    // Not-a-number, or farther away than whole numbers reach, is read at the border.
    const auto place = [](double at, int last) { return at > 0 ? static_cast<int>(std::min<double>(at, last)) : 0; };
    const int column = place(across, width - 1), row = place(down, height - 1);
    const double right = across - column, below = down - row;
    const size_t plane = static_cast<size_t>(width) * height;
    const double* cell = values + static_cast<size_t>(row) * width + column;
    for (int axis = 0; axis < 2; ++axis, cell += 4 * plane) {
        pinhole[axis] = cell[0] + cell[plane] * right + (cell[2 * plane] + cell[3 * plane] * right) * below;
    }
}

void BrownConrady::distort(double px[2]) const {
    const double y = (px[1] - cy) / fy, x = (px[0] - cx - skew * y) / fx;
    const double xy = x * y, xx = x * x, yy = y * y;
    const double r2 = xx + yy;
    const double radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
    px[0] = fx * (x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx)) + cx;
    px[1] = fy * (y * radial + p1 * (r2 + 2 * yy) + 2 * p2 * xy) + cy;
}

}  // namespace v2hdm
