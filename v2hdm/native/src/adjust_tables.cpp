#include "adjust_tables.h"

#include <algorithm>

// compose() must round as numpy does: its sums keep their order.
#if defined(__clang__)
#pragma clang fp reassociate(off) contract(off)
#elif defined(__GNUC__)
#pragma GCC optimize("no-associative-math")
#pragma GCC optimize("fp-contract=off")
#endif

namespace v2hdm::adjust {
namespace {

void product(const double* left, const double* right, int size, double* out) {
    for (int i = 0; i < size; ++i) {
        for (int j = 0; j < size; ++j) {
            double total = 0.0;
            for (int k = 0; k < size; ++k) total += left[i * size + k] * right[k * size + j];
            out[i * size + j] = total;
        }
    }
}

// Writes the skew matrix of w at rows of ``stride`` numbers.
void hat(const double* w, double* out, int stride) {
    const double values[3][3] = {{0, -w[2], w[1]}, {w[2], 0, -w[0]}, {-w[1], w[0], 0}};
    for (int i = 0; i < 3; ++i) std::copy(values[i], values[i] + 3, out + i * stride);
}

void move_one(const double* tangent, const double* dst_from_src, const Series& exp, double x, double* moved) {
    const double *shift = tangent, *turn = tangent + 3;
    const double sine = exp.at(0, x), cosine = exp.at(1, x), third = exp.at(2, x);
    double omega[9], square[9];
    hat(turn, omega, 3);
    product(omega, omega, 3, square);
    std::fill_n(moved, 16, 0.0);
    for (int i = 0; i < 3; ++i) {
        double translation = shift[i];
        for (int j = 0; j < 3; ++j) {
            translation += (cosine * omega[3 * i + j] + third * square[3 * i + j]) * shift[j];
            const double rotation = sine * omega[3 * i + j] + cosine * square[3 * i + j] + (i == j ? 1.0 : 0.0);
            for (int k = 0; k < 4; ++k) moved[4 * i + k] += rotation * dst_from_src[4 * j + k];
        }
        moved[4 * i + 3] += translation;
    }
    moved[15] = 1.0;
}

// The left Jacobian (6, 6), a polynomial of degree 4 in ad.
void differentiate_exp(const double* tangent, const Series& series, double x, double* jacobian) {
    double ad[36] = {}, power[36];
    hat(tangent + 3, ad, 6);
    hat(tangent + 3, ad + 21, 6);
    hat(tangent, ad + 3, 6);
    std::fill_n(jacobian, 36, 0.0);
    for (int i = 0; i < 6; ++i) jacobian[7 * i] = series.at(3, x);
    for (int n = 3; n >= 0; --n) {
        product(ad, jacobian, 6, power);
        std::copy(power, power + 36, jacobian);
        const double last = n == 0 ? 1.0 : series.at(n - 1, x);
        for (int i = 0; i < 6; ++i) jacobian[7 * i] += last;
    }
}

}  // namespace

void compose(
    const double* cameras, bool per_moment, const double* vehicle_from_map, Index count, Index moments, double* out) {
    for (Index c = 0; c < count; ++c) {
        for (Index m = 0; m < moments; ++m) {
            product(cameras + 16 * (per_moment ? c * moments + m : c), vehicle_from_map + 16 * m, 4, out);
            out += 16;
        }
    }
}

void move(
    const double* tangents, const double* dst_from_src, Index count, const Series& exp, const Series& left_jacobian,
    double* moved, double* jacobian) {
    for (Index c = 0; c < count; ++c) {
        const double *tangent = tangents + 6 * c, *turn = tangent + 3;
        const double x = -(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2]);
        move_one(tangent, dst_from_src + 16 * c, exp, x, moved + 16 * c);
        differentiate_exp(tangent, left_jacobian, x, jacobian + 36 * c);
    }
}

void gather(const int32_t* touched, Index count, const double* parts, Index columns, double* out) {
    for (Index i = 0; i < count; ++i) {
        double* sum = out + touched[i] * columns;
        for (Index p = 0; p < columns; ++p) sum[p] += parts[i * columns + p];
    }
}

}  // namespace v2hdm::adjust
