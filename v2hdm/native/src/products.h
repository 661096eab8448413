// Sums of products of rows of numbers.
#pragma once

#include <algorithm>

namespace v2hdm {
// Of no file but the one that includes it, as each may be compiled for another processor.
namespace {

inline double product(const float* a, const float* b, int count) {
    float total = 0.0f;
    for (int i = 0; i < count; ++i) total += a[i] * b[i];
    return total;
}

inline double sum(const float* a, int count) {
    float total = 0.0f;
    for (int i = 0; i < count; ++i) total += a[i];
    return total;
}

// The sums over ``count`` places of each row of a times each row of b: one alone waits for each addition.
template <int ROWS, int COLUMNS>
inline void products(
    const float* const (&a)[ROWS], const float* const (&b)[COLUMNS], int count, float (&sums)[ROWS][COLUMNS]) {
    float totals[ROWS][COLUMNS] = {};
    for (int i = 0; i < count; ++i) {
        for (int r = 0; r < ROWS; ++r) {
            for (int c = 0; c < COLUMNS; ++c) totals[r][c] += a[r][i] * b[c][i];
        }
    }
    for (int r = 0; r < ROWS; ++r) std::copy_n(totals[r], COLUMNS, sums[r]);
}

}  // namespace
}  // namespace v2hdm
