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
        const double aside_px = std::fabs(columns.pinhole_px[2 * k + axis] - intrinsic[2 + axis]);
        if (!(aside_px <= max_slope * intrinsic[axis])) return false;
    }
    return true;
}

bool is_rigid(const double* transform, double orthonormal_to) {
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j <= i; ++j) {
            const double *a = transform + 4 * i, *b = transform + 4 * j;
            const double product = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
            if (!(std::fabs(product - (i == j ? 1.0 : 0.0)) <= orthonormal_to)) return false;
        }
    }
    const double *a = transform, *b = transform + 4, *c = transform + 8, *last = transform + 12;
    const double determinant = a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) +
                               a[2] * (b[0] * c[1] - b[1] * c[0]);
    return determinant > 0 && last[0] == 0 && last[1] == 0 && last[2] == 0 && last[3] == 1;
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

namespace {

// A corner's observations by pair, and those of one pair by their number.
bool is_before(int32_t pair, int32_t number, int32_t other_pair, int32_t other_number) {
    return pair < other_pair || (pair == other_pair && number < other_number);
}

// Shell's sort, which needs no room; most runs are sorted already.
void sort_run(int32_t* pair, int32_t* order, Index count) {
    Index gap = 1;
    while (gap < count / 3) gap = 3 * gap + 1;
    for (; gap > 0; gap /= 3) {
        for (Index i = gap; i < count; ++i) {
            const int32_t moved_pair = pair[i], number = order[i];
            Index at = i;
            for (; at >= gap && is_before(moved_pair, number, pair[at - gap], order[at - gap]); at -= gap) {
                pair[at] = pair[at - gap];
                order[at] = order[at - gap];
            }
            pair[at] = moved_pair;
            order[at] = number;
        }
    }
}

}  // namespace

Index arrange(const Columns& columns, const Index* rank, Index frames, const Arranged& out) {
    for (Index k = 0; k < columns.count; ++k) {
        const Index corner = columns.corner[k];
        if (!(0 <= corner && corner < out.corners)) throw std::invalid_argument("observations: of no corner");
        out.corner_at[rank[corner] + 1] += 1;
    }
    for (Index c = 0; c < out.corners; ++c) out.corner_at[c + 1] += out.corner_at[c];
    for (Index k = 0; k < columns.count; ++k) {
        const Index corner = rank[columns.corner[k]], at = out.corner_at[corner]++;
        out.order[at] = static_cast<int32_t>(k);
        out.corner[at] = static_cast<int32_t>(corner);
        out.pair[at] = static_cast<int32_t>(columns.camera[k] * frames + columns.frame[k]);
    }
    Index begin = 0;
    for (Index i = 1; i <= columns.count; ++i) {
        if (i < columns.count && out.corner[i] == out.corner[begin]) continue;
        if (!std::is_sorted(out.pair + begin, out.pair + i)) sort_run(out.pair + begin, out.order + begin, i - begin);
        begin = i;
    }
    for (Index i = 1; i < columns.count; ++i) {
        if (out.corner[i] == out.corner[i - 1] && out.pair[i] == out.pair[i - 1]) return i;
    }
    return -1;
}

Index lay_out(const Columns& columns, const Sorted& sorted, double line_excess, double* measured, double* root) {
    return passes().lay_out(columns, sorted, line_excess, measured, root);
}

void classify(const Reported& reported, double gate, const Judged& out) {
    for (Index k = 0; k < reported.count; ++k) {
        const bool is_far = reported.mahalanobis2[k] > gate;
        out.verdict[k] = reported.behind[k] ? BEHIND_CAMERA : is_far ? CONTRADICTS : ACCEPTED;
        out.sightings[reported.corner[k]] += 1;
        out.accepted[reported.corner[k]] += out.verdict[k] == ACCEPTED;
    }
    const auto is_last = [&](Index c) { return out.accepted[c] == 1 && out.sightings[c] > 1; };
    Index last = 0;
    for (Index c = 0; c < out.corners; ++c) last += is_last(c);
    for (Index k = 0; k < (last ? reported.count : 0); ++k) {
        if (out.verdict[k] == ACCEPTED && is_last(reported.corner[k])) out.verdict[k] = UNCONFIRMED;
    }
}

Index first_not_rigid(const double* transforms, Index count, double orthonormal_to) {
    for (Index k = 0; k < count; ++k) {
        if (!is_rigid(transforms + 16 * k, orthonormal_to)) return k;
    }
    return -1;
}

Index find_touched(const int32_t* pair, const Index* chunk, Index chunks, uint8_t* is_touched, const Touched& out) {
    Index count = 0;
    for (Index q = 0; q < chunks; ++q) {
        out.at[q] = count;
        Index lowest = std::numeric_limits<Index>::max(), highest = -1;
        for (Index k = chunk[q]; k < chunk[q + 1]; ++k) {
            is_touched[pair[k]] = 1;
            lowest = std::min<Index>(lowest, pair[k]);
            highest = std::max<Index>(highest, pair[k]);
        }
        for (Index p = lowest; p <= highest; ++p) {
            if (is_touched[p]) out.pair[count++] = static_cast<int32_t>(p);
            is_touched[p] = 0;
        }
    }
    out.at[chunks] = count;
    return count;
}

}  // namespace v2hdm::adjust
