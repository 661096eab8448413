// Poses of pairs, and sums over chunks; twin of v2hdm.adjust.kernels.tables and of engine._gather.
#pragma once

#include "adjust.h"

namespace v2hdm::adjust {

// Products (C, M, 4, 4) of cameras (C, moments or 1, 4, 4) with transforms (M, 4, 4), rounded as numpy does.
void compose(const double* cameras, bool per_moment, const double* vehicle_from_map, Index count, Index moments, double* out);

// Coefficients of a power series, (terms, columns).
struct Series {
    const double* terms;
    Index count, columns;

    double at(Index column, double x) const {
        double total = terms[(count - 1) * columns + column];
        for (Index n = count - 2; n >= 0; --n) total = terms[n * columns + column] + total * x;
        return total;
    }
};

// exp(tangents) @ dst_from_src (C, 4, 4), and the left Jacobians (C, 6, 6) of the tangents (C, 6).
void move(
    const double* tangents, const double* dst_from_src, Index count, const Series& exp, const Series& left_jacobian,
    double* moved, double* jacobian);

// Sums (P, n) of parts (count, n) by the pairs that they touch.
void gather(const int32_t* touched, Index count, const double* parts, Index columns, double* out);

}  // namespace v2hdm::adjust
