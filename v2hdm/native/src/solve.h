// Small symmetric systems of equations.
#pragma once

#include <cmath>
#include <utility>

namespace v2hdm {
// Of no file but the one that includes it, as each may be compiled for another processor.
namespace {

// Solve A x = b by Gaussian elimination with pivots; not-a-number where A is singular. Overwrites both.
template <int SIZE>
void eliminate(double (&a)[SIZE][SIZE], double (&x)[SIZE]) {
    for (int k = 0; k < SIZE; ++k) {
        int pivot = k;
        for (int i = k + 1; i < SIZE; ++i) {
            if (std::abs(a[i][k]) > std::abs(a[pivot][k])) pivot = i;
        }
        std::swap(x[k], x[pivot]);
        for (int j = 0; j < SIZE; ++j) std::swap(a[k][j], a[pivot][j]);
        for (int i = k + 1; i < SIZE; ++i) {
            const double factor = a[i][k] / a[k][k];
            for (int j = k; j < SIZE; ++j) a[i][j] -= factor * a[k][j];
            x[i] -= factor * x[k];
        }
    }
    for (int i = SIZE - 1; i >= 0; --i) {
        for (int j = i + 1; j < SIZE; ++j) x[i] -= a[i][j] * x[j];
        x[i] /= a[i][i];
    }
}

// Solve A x = b for a symmetric A, by Cholesky's factors where it has them; x begins as b.
template <int SIZE>
void solve_symmetric(const double (&a)[SIZE][SIZE], double (&x)[SIZE]) {
    double factor[SIZE][SIZE];
    for (int i = 0; i < SIZE; ++i) {
        for (int j = 0; j <= i; ++j) {
            double rest = a[i][j];
            for (int k = 0; k < j; ++k) rest -= factor[i][k] * factor[j][k];
            if (i != j) {
                factor[i][j] = rest * factor[j][j];
            } else if (rest > 0) {
                factor[i][i] = 1 / std::sqrt(rest);  // the diagonal's inverse
            } else {
                double copy[SIZE][SIZE];
                for (int r = 0; r < SIZE; ++r) {
                    for (int c = 0; c < SIZE; ++c) copy[r][c] = a[r][c];
                }
                eliminate(copy, x);
                return;
            }
        }
    }
    for (int i = 0; i < SIZE; ++i) {
        for (int k = 0; k < i; ++k) x[i] -= factor[i][k] * x[k];
        x[i] *= factor[i][i];
    }
    for (int i = SIZE - 1; i >= 0; --i) {
        for (int k = i + 1; k < SIZE; ++k) x[i] -= factor[k][i] * x[k];
        x[i] *= factor[i][i];
    }
}

}  // namespace
}  // namespace v2hdm
