// Sums of products of rows of numbers.
#pragma once

#include <algorithm>

namespace v2hdm {
// Of no file but the one that includes it, as each may be compiled for another processor.
namespace {

constexpr int CHUNK = 128;  // places that are worked on together: all rows of so many are near the processor

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

// Add the weighted products of rows with each other to the lower triangle of ``sums``.
template <int SIZE>
void add_products(const float (&rows)[SIZE][CHUNK], const float* weight, int count, double (&sums)[SIZE][SIZE]) {
    constexpr int ROWS = 2, COLUMNS = 4;  // as many sums as a processor has registers for
    float weighted[ROWS][CHUNK];
    for (int begin = 0; begin < SIZE; begin += ROWS) {
        for (int r = 0; r < ROWS; ++r) {
            const float* values = rows[std::min(begin + r, SIZE - 1)];
            for (int i = 0; i < count; ++i) weighted[r][i] = values[i] * weight[i];
        }
        for (int other = 0; other < std::min(begin + ROWS, SIZE); other += COLUMNS) {
            const float* columns[COLUMNS];
            for (int c = 0; c < COLUMNS; ++c) columns[c] = rows[std::min(other + c, SIZE - 1)];
            float totals[ROWS][COLUMNS];
            products({weighted[0], weighted[1]}, columns, count, totals);
            for (int r = 0; r < ROWS && begin + r < SIZE; ++r) {
                for (int c = 0; c < COLUMNS && other + c < SIZE; ++c) sums[begin + r][other + c] += totals[r][c];
            }
        }
    }
}

}  // namespace
}  // namespace v2hdm
