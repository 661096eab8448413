#include "lens.h"

namespace v2hdm {

void BrownConrady::distort(double px[2]) const {
    const double y = (px[1] - cy) / fy, x = (px[0] - cx - skew * y) / fx;
    const double xy = x * y, xx = x * x, yy = y * y;
    const double r2 = xx + yy;
    const double radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
    px[0] = fx * (x * radial + 2 * p1 * xy + p2 * (r2 + 2 * xx)) + cx;
    px[1] = fy * (y * radial + p1 * (r2 + 2 * yy) + 2 * p2 * xy) + cy;
}

}  // namespace v2hdm
