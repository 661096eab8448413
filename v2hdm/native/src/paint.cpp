#include "paint.h"

#include <algorithm>
#include <cstring>

#include "vector_math.h"

namespace v2hdm {
namespace {

constexpr float LEAST_LEVEL = 1e-3f;  // least size of the level of a piece, and beside it
constexpr int FOUR = 4;  // elements of a map of pieces that are compared at once

uint64_t four_of(const int16_t* piece) {
    uint64_t bits;
    std::memcpy(&bits, piece, sizeof bits);
    return bits;
}

// Set the probabilities of classes whose log odds lie ``plane`` apart, and return the likeliest.
size_t soften(const float* odds, size_t plane, std::vector<float>& share) {
    size_t best = 0;
    for (size_t k = 0; k < share.size(); ++k) {
        share[k] = odds[k * plane];
        if (share[k] > share[best]) best = k;
    }
    const float most_odds = share[best];
    float total = 0.0f;
    for (float& value : share) total += value = exponential(value - most_odds);
    for (float& value : share) value /= total;
    return best;
}

}  // namespace

std::vector<std::vector<double>> outlines(const PieceMap& map, int count) {
    std::vector<std::vector<double>> points(static_cast<size_t>(count));
    // First those below an element, then those right of it, as numpy has them.
    for (int axis = 0; axis < 2; ++axis) {
        const int step = axis == 0 ? map.width : 1;
        const int height = axis == 0 ? map.height - 1 : map.height, width = axis == 0 ? map.width : map.width - 1;
        for (int i = 0; i < height; ++i) {
            const int16_t* piece = map.piece + static_cast<size_t>(i) * map.width;
            const float* level = map.level + static_cast<size_t>(i) * map.width;
            for (int j = 0; j < width; ++j) {
                while (j + FOUR < width && four_of(piece + j) == four_of(piece + j + step)) j += FOUR;
                if (piece[j] == piece[j + step]) continue;
                const int owner = std::max(piece[j], piece[j + step]);
                if (owner < 1 || owner > count) continue;
                const double fraction = level[j] / (level[j] - level[j + step]);
                auto& own = points[static_cast<size_t>(owner) - 1];
                own.push_back(axis == 0 ? j : j + fraction);
                own.push_back(axis == 0 ? i + fraction : i);
            }
        }
    }
    return points;
}

void sign(const PieceMap& map, int piece, const Box& box, float* levels) {
    for (int i = box.first_row; i < box.last_row; ++i) {
        const size_t row = static_cast<size_t>(i) * map.width;
        for (int j = box.first_column; j < box.last_column; ++j) {
            const float level = map.level[row + j];
            *levels++ = map.piece[row + j] == piece ? most(level, LEAST_LEVEL) : least(level, -LEAST_LEVEL);
        }
    }
}

Tally tally(const PieceMap& map, const Kinds& kinds, int count) {
    const size_t classes = static_cast<size_t>(kinds.classes), pieces = static_cast<size_t>(count);
    Tally sums = {
        std::vector<int64_t>(pieces), std::vector<int64_t>(pieces * classes), std::vector<double>(pieces),
        std::vector<double>(pieces * classes),
    };
    const size_t plane = static_cast<size_t>(kinds.height) * kinds.width;
    std::vector<float> share(classes);
    const float* last_odds = nullptr;
    size_t best = 0;
    for (int i = 0; i < map.height; ++i) {
        const int row = std::clamp(static_cast<int>((i + kinds.first_row) / kinds.scale), 0, kinds.height - 1);
        for (int j = 0; j < map.width; ++j) {
            const size_t element = static_cast<size_t>(i) * map.width + j;
            const int owner = map.piece[element];
            if (owner < 1 || owner > count) continue;
            const size_t p = static_cast<size_t>(owner) - 1;
            const int column = std::clamp(static_cast<int>((j + kinds.first_column) / kinds.scale), 0, kinds.width - 1);
            const float* odds = kinds.odds + static_cast<size_t>(row) * kinds.width + column;
            // Neighbours have the same odds where the paint is finer.
            if (odds != last_odds) best = soften(odds, plane, share);
            last_odds = odds;
            for (size_t k = 0; k < classes; ++k) sums.probability[p * classes + k] += share[k];
            sums.best[p * classes + best] += 1;
            sums.cells[p] += 1;
            // Beyond 30 a probability is the same: network.as_probability.
            const float odds_of_paint = least(most(map.level[element], -30.0f), 30.0f);
            sums.certainty[p] += 1 / (1 + exponential(-odds_of_paint));
        }
    }
    return sums;
}

}  // namespace v2hdm
