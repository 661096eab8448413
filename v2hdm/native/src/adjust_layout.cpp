#include "adjust_layout.h"

#include <cmath>
#include <limits>

namespace v2hdm::adjust {
namespace {

bool is_sound(const Columns& columns, Index k, double symmetric_to, double max_slope) {
    const double* covariance = columns.covariance_px + 4 * k;
    const double xx = covariance[0], xy = covariance[1], yx = covariance[2], yy = covariance[3];
    const double most = std::numeric_limits<double>::infinity();
    if (!(xx > 0 && xx * yy > yx * yx && xx * yy < most)) return false;
    if (!((xy - yx) * (xy - yx) <= symmetric_to * symmetric_to * xx * yy)) return false;
    const double* intrinsic = columns.intrinsic + 4 * columns.camera[k];
    for (int axis = 0; axis < 2; ++axis) {
        const double slope = (columns.pinhole_px[2 * k + axis] - intrinsic[2 + axis]) / intrinsic[axis];
        if (!(std::fabs(slope) <= max_slope)) return false;
    }
    return true;
}

}  // namespace

Index first_unsound(
    const Columns& columns, Index frames, double symmetric_to, double max_slope, const Tally& tally) {
    for (Index k = 0; k < columns.count; ++k) {
        const Index c = columns.camera[k], n = columns.corner[k], frame = columns.frame[k];
        const bool is_within = 0 <= c && c < tally.cameras && 0 <= frame && frame < frames && 0 <= n && n < tally.corners;
        if (!is_within) return k;
        tally.by_corner[n] += 1;
        tally.by_camera[c] += 1;
        if (!is_sound(columns, k, symmetric_to, max_slope)) return k;
    }
    return -1;
}

Index lay_out(const Columns& columns, const Index* rank, Index frames, const Index* order, const Ordered& out) {
    Index again = -1;
    const Index count = columns.count;
    for (Index i = 0; i < count; ++i) {
        const Index k = order[i], c = columns.camera[k];
        out.corner[i] = static_cast<int32_t>(rank[columns.corner[k]]);
        out.pair[i] = static_cast<int32_t>(c * frames + columns.frame[k]);
        if (i && again < 0 && out.corner[i] == out.corner[i - 1] && out.pair[i] == out.pair[i - 1]) again = i;
        const double* intrinsic = columns.intrinsic + 4 * c;
        const double fx = intrinsic[0], fy = intrinsic[1];
        out.measured[i] = (columns.pinhole_px[2 * k] - intrinsic[2]) / fx;
        out.measured[count + i] = (columns.pinhole_px[2 * k + 1] - intrinsic[3]) / fy;
        const double* covariance = columns.covariance_px + 4 * k;
        const double first = std::sqrt(covariance[0]), below = covariance[2] / first;
        const double last = std::sqrt(covariance[3] - below * below);
        out.root[i] = fx / first;
        out.root[count + i] = -below * fx / (first * last);
        out.root[2 * count + i] = fy / last;
    }
    return again;
}

}  // namespace v2hdm::adjust
