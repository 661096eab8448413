#include "adjust_layout.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

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

constexpr Index AHEAD = 16;  // observations ahead: about as long as memory takes

// Has an observation, of which the next is anywhere in memory, on its way.
void prefetch(const Columns& columns, Index k) {
#ifdef __GNUC__
    __builtin_prefetch(columns.camera + k);
    __builtin_prefetch(columns.pinhole_px + 2 * k);
    __builtin_prefetch(columns.covariance_px + 4 * k);
#else
    static_cast<void>(columns), static_cast<void>(k);
#endif
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

Index arrange(const Columns& columns, const Index* rank, Index frames, const Arranged& out) {
    const auto pair_of = [&](Index k) { return columns.camera[k] * frames + columns.frame[k]; };
    for (Index k = 0; k < columns.count; ++k) {
        const Index pair = pair_of(k), corner = columns.corner[k];
        const bool is_within = 0 <= pair && pair < out.pairs && 0 <= corner && corner < out.corners;
        if (!is_within) throw std::invalid_argument("observations: of a camera, frame or corner that there is not");
        out.pair_at[pair + 1] += 1;
        out.corner_at[rank[corner] + 1] += 1;
    }
    for (Index p = 0; p < out.pairs; ++p) out.pair_at[p + 1] += out.pair_at[p];
    for (Index c = 0; c < out.corners; ++c) out.corner_at[c + 1] += out.corner_at[c];
    for (Index k = 0; k < columns.count; ++k) out.by_pair[out.pair_at[pair_of(k)]++] = static_cast<int32_t>(k);
    for (Index i = 0; i < columns.count; ++i) {
        const int32_t k = out.by_pair[i];
        const Index corner = rank[columns.corner[k]], at = out.corner_at[corner]++;
        out.order[at] = k;
        out.corner[at] = static_cast<int32_t>(corner);
        out.pair[at] = static_cast<int32_t>(pair_of(k));
    }
    for (Index i = 1; i < columns.count; ++i) {
        if (out.corner[i] == out.corner[i - 1] && out.pair[i] == out.pair[i - 1]) return i;
    }
    return -1;
}

void lay_out(const Columns& columns, const int32_t* order, double* measured, double* root) {
    const Index count = columns.count;
    for (Index i = 0; i < count; ++i) {
        prefetch(columns, order[std::min(i + AHEAD, count - 1)]);
        const Index k = order[i];
        const double* intrinsic = columns.intrinsic + 4 * columns.camera[k];
        const double fx = intrinsic[0], fy = intrinsic[1];
        measured[i] = (columns.pinhole_px[2 * k] - intrinsic[2]) / fx;
        measured[count + i] = (columns.pinhole_px[2 * k + 1] - intrinsic[3]) / fy;
        const double* covariance = columns.covariance_px + 4 * k;
        const double over_first = 1 / std::sqrt(covariance[0]), below = covariance[2] * over_first;
        const double over_last = 1 / std::sqrt(covariance[3] - below * below);
        root[i] = fx * over_first;
        root[count + i] = -below * fx * over_first * over_last;
        root[2 * count + i] = fy * over_last;
    }
}

}  // namespace v2hdm::adjust
