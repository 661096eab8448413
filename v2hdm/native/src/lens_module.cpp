// What Python calls of lenses.
#include <algorithm>

#include "arrays.h"
#include "lens.h"
#include "modules.h"

namespace v2hdm {
namespace {

using namespace nb::literals;

// Recorded px (N, 2) to pinhole px, in place.
void undistort(nb::handle points_object, nb::handle table_object, double step_px) {
    const auto points = array_of<double, 2>(points_object, "points");
    const auto table = array_of<const double, 4>(table_object, "table");
    if (points.shape(1) != 2 || table.shape(2) != 2 || table.shape(3) != 4 || table.size() == 0) {
        throw std::invalid_argument("points or table: of another shape");
    }
    const LensTable lens = {table.data(), static_cast<int>(table.shape(1)), static_cast<int>(table.shape(0)), step_px};
    for (size_t i = 0; i < points.shape(0); ++i) {
        double pinhole[2];
        lens.undistort(points.data()[2 * i], points.data()[2 * i + 1], pinhole);
        std::copy(pinhole, pinhole + 2, points.data() + 2 * i);
    }
}

// Pinhole px (N, 2) to recorded px, in place.
void distort(nb::handle points_object, nb::handle intrinsic_object, nb::handle coefficients_object) {
    const auto points = array_of<double, 2>(points_object, "points");
    const auto intrinsic = array_of<const double, 2>(intrinsic_object, "intrinsic");
    const auto coefficients = array_of<const double, 1>(coefficients_object, "coefficients");
    if (points.shape(1) != 2 || intrinsic.shape(0) != 3 || intrinsic.shape(1) != 3 || coefficients.size() != 8) {
        throw std::invalid_argument("points, intrinsic or coefficients: of another shape");
    }
    const double *k = intrinsic.data(), *c = coefficients.data();
    const BrownConrady lens = {k[0], k[4], k[2], k[5], k[1], c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7]};
    for (size_t i = 0; i < points.shape(0); ++i) lens.distort(points.data() + 2 * i);
}

}  // namespace

void add_lens(nb::module_& module) {
    module.def("undistort", &undistort, "points"_a, "table"_a, "step_px"_a);
    module.def("distort", &distort, "points"_a, "intrinsic"_a, "coefficients"_a);
}

}  // namespace v2hdm
