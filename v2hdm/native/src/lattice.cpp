#include "lattice.h"

#include <algorithm>
#include <cmath>

#include "vector_math.h"

namespace v2hdm {
namespace {

constexpr int COLOURS = 3;  // in which a marking is looked for: grey, red and blue

struct Seen {
    float light[COLOURS];
    bool use, clipped;
};

Seen see(const Source& source, const Marking& marking, int64_t u, int64_t v) {
    Seen seen;
    seen.use = u >= 0 && u < source.width && v >= 0 && v < source.height;
    u = std::clamp<int64_t>(u, 0, source.width - 1);
    v = std::clamp<int64_t>(v, 0, source.height - 1);
    const uint8_t* code = source.image + 3 * (v * source.width + u);
    // Rows above the first of the paint are as the first.
    const int64_t row = std::clamp<int64_t>(v >= source.top ? (v - source.top) / source.stride : 0, 0, source.owner_height - 1);
    const int64_t column = std::min<int64_t>(u / source.stride, source.owner_width - 1);
    const int owner = source.owner[row * source.owner_width + column];
    seen.use = seen.use && (owner == 0 || (owner >= marking.first_piece + 1 && owner <= marking.last_piece + 1));
    float grey = 0.0f;
    for (int colour = 0; colour < 3; ++colour) grey += source.radiance[code[colour]] * source.grey[colour];
    seen.light[0] = logarithm(most(grey, 0.0f) + source.dark);
    seen.light[1] = source.logs[code[2]];
    seen.light[2] = source.logs[code[0]];
    const int highest = std::max({code[0], code[1], code[2]});
    seen.clipped = seen.use && highest >= source.clipped;
    return seen;
}

// In which colour inside and outside differ most; lattice._clearest.
int clearest(const std::vector<float>& light, const std::vector<uint8_t>& part, int count, double grey_first) {
    double best = -1.0;
    int chosen = 0;
    double number[3];
    for (int p = 0; p < 3; ++p) number[p] = std::max<double>(std::count(part.begin(), part.end(), p), 1.0);
    for (int colour = 0; colour < COLOURS; ++colour) {
        double mean[3] = {}, square[3] = {};
        for (int i = 0; i < count; ++i) {
            const double value = light[COLOURS * i + colour];
            mean[part[i]] += value;
            square[part[i]] += value * value;
        }
        double scatter = 0.0;
        for (int p = 1; p < 3; ++p) {
            mean[p] /= number[p];
            scatter += std::max(square[p] / number[p] - mean[p] * mean[p], 0.0);
        }
        double clearness = std::abs(mean[1] - mean[2]) / std::sqrt(scatter + 1e-4);
        if (colour == 0) clearness *= grey_first;
        if (clearness > best) {
            best = clearness;
            chosen = colour;
        }
    }
    return chosen;
}

// What of the points in the frame is told by their places: the nearest side, and the light's basis.
//
// ``nearest`` becomes how far outside of that side each is. Row by row compilers make vector instructions of it.
void place(const Marking& marking, int count, std::vector<float>& nearest, LatticeRows& rows) {
    const float *x = rows.points, *y = rows.points + rows.stride;
    for (int s = 0; s < 4; ++s) {
        const float* row = marking.outward + 3 * s;
        float* outside = rows.of_side + s * rows.stride;
        for (int i = 0; i < count; ++i) outside[i] = row[0] * x[i] + row[1] * y[i] + row[2];
        for (int i = 0; i < count; ++i) nearest[i] = s == 0 || outside[i] > nearest[i] ? outside[i] : nearest[i];
    }
    for (int s = 0; s < 4; ++s) {
        float* of_side = rows.of_side + s * rows.stride;
        for (int i = 0; i < count; ++i) of_side[i] = of_side[i] == nearest[i] ? rows.use[i] : 0.0f;
    }
    const float *along = marking.axes, *across = marking.axes + 3;
    float* knot = rows.across;  // until it is known how far across they are
    for (int i = 0; i < count; ++i) {
        const float placed = least(most(along[0] * x[i] + along[1] * y[i] + along[2], -1.0f), 1.0f);
        knot[i] = (placed + 1) * (static_cast<float>(HATS - 1) / 2);
    }
    for (int k = 0; k < HATS; ++k) {
        float* hat = rows.hats + k * rows.stride;
        for (int i = 0; i < count; ++i) hat[i] = most(1 - std::abs(knot[i] - static_cast<float>(k)), 0.0f);
    }
    for (int i = 0; i < count; ++i) {
        rows.across[i] = least(most(across[0] * x[i] + across[1] * y[i] + across[2], -1.0f), 1.0f);
    }
}

}  // namespace

void look(
    const Source& source,
    const Marking& marking,
    int count,
    const int64_t* u,
    const int64_t* v,
    double grey_first,
    LatticeRows& rows) {
    std::vector<float> light(static_cast<size_t>(COLOURS) * count);
    std::vector<uint8_t> part(count);  // 1 inside, 2 outside, 0 for none
    int used = 0, clipped = 0;
    for (int i = 0; i < count; ++i) {
        const Seen seen = see(source, marking, u[i], v[i]);
        std::copy(seen.light, seen.light + COLOURS, light.begin() + static_cast<size_t>(COLOURS) * i);
        double pinhole[2];
        source.lens.undistort(static_cast<double>(u[i]), static_cast<double>(v[i]), pinhole);
        const double off[2] = {pinhole[0] - marking.middle[0], pinhole[1] - marking.middle[1]};
        const float x = static_cast<float>(off[0] * marking.scale[0] + off[1] * marking.scale[1]);
        const float y = static_cast<float>(off[0] * marking.scale[2] + off[1] * marking.scale[3]);
        rows.points[i] = x;
        rows.points[rows.stride + i] = y;
        rows.points[2 * rows.stride + i] = 1.0f;
        rows.use[i] = seen.use ? 1.0f : 0.0f;
        rows.limited[i] = seen.clipped;
        used += seen.use;
        clipped += seen.clipped;
    }
    std::vector<float> nearest(count);
    place(marking, count, nearest, rows);
    for (int i = 0; i < count; ++i) part[i] = rows.use[i] > 0.0f ? (nearest[i] < 0 ? 1 : 2) : 0;
    const int colour = clearest(light, part, count, grey_first);
    for (int i = 0; i < count; ++i) rows.values[i] = light[static_cast<size_t>(COLOURS) * i + colour];
    *rows.clipped = static_cast<double>(clipped) / std::max(used, 1);
}

Chosen choose(const Band& band) {
    const int width = band.columns, height = band.rows;
    std::vector<int> place(static_cast<size_t>(width + 1) * (height + 1), -1);  // in the list of all
    std::vector<int64_t> column, row;
    for (int i = 0; i < height; ++i) {
        float down[4];
        for (int s = 0; s < 4; ++s) {
            down[s] = band.outward[3 * s + 1] * static_cast<float>(band.row[i]) + band.outward[3 * s + 2];
        }
        for (int j = 0; j < width; ++j) {
            float outside = down[0] + band.outward[0] * static_cast<float>(band.column[j]);
            for (int s = 1; s < 4; ++s) {
                const float beyond = down[s] + band.outward[3 * s] * static_cast<float>(band.column[j]);
                outside = beyond > outside ? beyond : outside;
            }
            if (!(outside < band.outside_px && outside > -band.inside_px)) continue;
            place[static_cast<size_t>(i) * (width + 1) + j] = static_cast<int>(column.size());
            column.push_back(j);
            row.push_back(i);
        }
    }
    const int all = static_cast<int>(column.size());
    const int thin = std::max((all + band.most - 1) / band.most, 1);
    Chosen chosen;
    for (int k = 0; k < all; k += thin) {
        const int64_t i = row[k], j = column[k];
        int64_t right = 0, below = 0;
        if (thin == 1) {
            const size_t cell = static_cast<size_t>(i) * (width + 1) + j;
            if (band.near_right[j]) right = std::max(place[cell + 1], 0);
            if (band.near_below[i]) below = std::max(place[cell + width + 1], 0);
        } else if (k + thin < all && row[k + thin] == i) {
            right = k / thin + 1;  // where a band is thinned, the next in its row is the neighbour
        }
        chosen.column.push_back(band.column[j]);
        chosen.row.push_back(band.row[i]);
        chosen.right.push_back(right);
        chosen.below.push_back(below);
    }
    return chosen;
}

}  // namespace v2hdm
