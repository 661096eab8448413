// What Python calls of a localiser.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "arrays.h"
#include "modules.h"
#include "seeing.h"

namespace v2hdm {
namespace {

using namespace nb::literals;

template <typename Value, int DIMENSIONS>
Array<const Value, DIMENSIONS> shaped(nb::handle object, const char* name, std::initializer_list<size_t> shape) {
    const auto array = array_of<const Value, DIMENSIONS>(object, name);
    size_t axis = 0;
    for (const size_t size : shape) {
        if (array.shape(axis++) != size) throw std::invalid_argument(std::string(name) + ": of another shape");
    }
    return array;
}

// Points (N, 3) of the map in an image: px (N, 2), depth (N), derivatives (N, 2, 17) and (N, 2, 2).
nb::tuple expect_points(
    nb::handle points_object, nb::handle pose, nb::handle calibrated, nb::handle tangent, nb::handle intrinsic,
    double nearest_m) {
    const auto points = array_of<const double, 2>(points_object, "points");
    const size_t count = points.shape(0);
    if (points.shape(1) != 3) throw std::invalid_argument("points: of another shape");
    const auto map_from_vehicle = shaped<double, 2>(pose, "map_from_vehicle", {4, 4});
    const auto cam_from_vehicle = shaped<double, 2>(calibrated, "cam_from_vehicle", {4, 4});
    const auto error = shaped<double, 1>(tangent, "tangent", {CAMERA_STATES});
    const auto matrix = shaped<double, 2>(intrinsic, "intrinsic", {3, 3});
    const SeeingCamera camera(map_from_vehicle.data(), cam_from_vehicle.data(), error.data(), matrix.data());
    const Made<double> px({count, 2}), depth_m({count}), by_states({count, 2, IMAGE_STATES}), by_place({count, 2, 2});
    for (size_t i = 0; i < count; ++i) {
        const SeenPoint point = {
            px.data + 2 * i, depth_m.data + i, by_states.data + 2 * IMAGE_STATES * i, by_place.data + 4 * i};
        expect_point(camera, points.data() + 3 * i, nearest_m, point);
    }
    return nb::make_tuple(px.array, depth_m.array, by_states.array, by_place.array);
}

// Derivatives (M, 8, m) of markings by the whitened states that a root (n, m) stands for.
nb::object spread(
    nb::handle root_object, nb::handle by_states_object, nb::handle by_place_object, nb::handle states_object,
    int64_t camera_begin) {
    const auto root = array_of<const double, 2>(root_object, "root");
    const auto states = array_of<const int64_t, 1>(states_object, "states");
    const size_t count = states.shape(0), width = root.shape(1);
    const auto by_states = shaped<double, 3>(by_states_object, "by_states", {count, PAIR, IMAGE_STATES});
    const auto by_place = shaped<double, 3>(by_place_object, "by_place", {count, PAIR, 2});
    const int64_t last = static_cast<int64_t>(root.shape(0)) - 2;
    if (camera_begin < VEHICLE_STATES || camera_begin + CAMERA_STATES > last + 2) {
        throw std::invalid_argument("camera_begin: beyond the states");
    }
    for (size_t i = 0; i < count; ++i) {
        if (states.data()[i] > last) throw std::invalid_argument("states: beyond the root");
    }
    const Roots roots = {root.data(), width, static_cast<size_t>(camera_begin)};
    const Made<double> out({count, PAIR, width});
    for (size_t i = 0; i < count; ++i) {
        const double *by = by_states.data() + PAIR * IMAGE_STATES * i, *place = by_place.data() + PAIR * 2 * i;
        spread_pair(roots, by, place, states.data()[i], out.data + PAIR * width * i);
    }
    return out.array;
}

// The covariances (P, 8, 8) of detections, in the order of their markings' corners, and of these.
nb::object pair_noise(
    nb::handle covariance_object, nb::handle detection_object, nb::handle order_object, double factor,
    nb::handle map_object, nb::handle by_place_object) {
    const auto covariance = array_of<const double, 3>(covariance_object, "covariance");
    const auto detection = array_of<const int64_t, 1>(detection_object, "detection");
    const size_t count = detection.shape(0);
    const auto order = shaped<int64_t, 2>(order_object, "order", {count, PAIR});
    const auto map_m2 = shaped<double, 3>(map_object, "map_m2", {count, PAIR, PAIR});
    const auto by_place = shaped<double, 3>(by_place_object, "by_place", {count, PAIR, 2});
    if (covariance.shape(1) != PAIR || covariance.shape(2) != PAIR) throw std::invalid_argument("covariance: of another shape");
    const auto is_within = [](int64_t number, size_t size) { return number >= 0 && number < static_cast<int64_t>(size); };
    for (size_t i = 0; i < count; ++i) {
        if (!is_within(detection.data()[i], covariance.shape(0))) throw std::invalid_argument("detection: beyond the look");
        for (int row = 0; row < PAIR; ++row) {
            if (!is_within(order.data()[PAIR * i + row], PAIR)) throw std::invalid_argument("order: beyond the corners");
        }
    }
    const Made<double> out({count, PAIR, PAIR});
    for (size_t i = 0; i < count; ++i) {
        const double* of_detection = covariance.data() + PAIR * PAIR * detection.data()[i];
        noise_pair(
            of_detection, order.data() + PAIR * i, factor, map_m2.data() + PAIR * PAIR * i,
            by_place.data() + PAIR * 2 * i, out.data + PAIR * PAIR * i);
    }
    return out.array;
}

// The noise (P, 8, 8), residuals (P, 8) and slopes (P, 8, m) of pairs of a detection and a marking.
struct Pairs {
    Pairs(nb::handle noise_object, nb::handle residual_object, nb::handle slope_object)
        : noise(array_of<const double, 3>(noise_object, "noise")),
          residual(array_of<const double, 2>(residual_object, "residual")),
          slope(array_of<const double, 3>(slope_object, "slope")),
          count(noise.shape(0)),
          width(slope.shape(2)) {
        const bool noise_fits = noise.shape(1) == PAIR && noise.shape(2) == PAIR;
        const bool residual_fits = residual.shape(0) == count && residual.shape(1) == PAIR;
        if (!noise_fits || !residual_fits || slope.shape(0) != count || slope.shape(1) != PAIR) {
            throw std::invalid_argument("noise, residual or slope: of another shape");
        }
    }

    const Array<const double, 3> noise;
    const Array<const double, 2> residual;
    const Array<const double, 3> slope;
    const size_t count;
    const size_t width;
};

// Residuals (P, 8) and slopes (P, 8, m) less the noise's (P, 8, 8) factors; not-a-number where it has none.
nb::tuple whiten(nb::handle noise_object, nb::handle residual_object, nb::handle slope_object) {
    const Pairs pairs(noise_object, residual_object, slope_object);
    const auto& [noise, residual, slope, count, width] = pairs;
    const Made<double> residuals({count, PAIR}), slopes({count, PAIR, width});
    std::copy(residual.data(), residual.data() + PAIR * count, residuals.data);
    std::copy(slope.data(), slope.data() + PAIR * width * count, slopes.data);
    for (size_t i = 0; i < count; ++i) {
        double factor[PAIR * PAIR];
        std::copy(noise.data() + PAIR * PAIR * i, noise.data() + PAIR * PAIR * (i + 1), factor);
        if (!factor_pair(factor)) std::fill(factor, factor + PAIR * PAIR, std::numeric_limits<double>::quiet_NaN());
        whiten_pair(factor, residuals.data + PAIR * i, 1);
        whiten_pair(factor, slopes.data + PAIR * width * i, width);
    }
    return nb::make_tuple(residuals.array, slopes.array);
}

// Squared distances (P) of residuals (P, 8) by slopes and noise together, and log determinants (P).
nb::tuple distances(nb::handle noise_object, nb::handle residual_object, nb::handle slope_object) {
    const Pairs pairs(noise_object, residual_object, slope_object);
    const auto& [noise, residual, slope, count, width] = pairs;
    const Made<double> squared({count}), log_determinant({count});
    for (size_t i = 0; i < count; ++i) {
        double total[PAIR * PAIR], whitened[PAIR];
        const double* rows = slope.data() + PAIR * width * i;
        for (int row = 0; row < PAIR; ++row) {
            for (int column = 0; column <= row; ++column) {
                double sum = noise.data()[PAIR * PAIR * i + PAIR * row + column];
                for (size_t k = 0; k < width; ++k) sum += rows[row * width + k] * rows[column * width + k];
                total[PAIR * row + column] = sum;
            }
        }
        std::copy(residual.data() + PAIR * i, residual.data() + PAIR * (i + 1), whitened);
        if (!factor_pair(total)) std::fill(total, total + PAIR * PAIR, std::numeric_limits<double>::quiet_NaN());
        whiten_pair(total, whitened, 1);
        for (int row = 0; row < PAIR; ++row) {
            squared.data[i] += whitened[row] * whitened[row];
            log_determinant.data[i] -= 2 * std::log(total[PAIR * row + row]);
        }
    }
    return nb::make_tuple(squared.array, log_determinant.array);
}

}  // namespace

void add_seeing(nb::module_& module) {
    module.def(
        "expect_points", &expect_points, "points"_a, "map_from_vehicle"_a, "cam_from_vehicle"_a, "tangent"_a,
        "intrinsic"_a, "nearest_m"_a);
    module.def("spread", &spread, "root"_a, "by_states"_a, "by_place"_a, "states"_a, "camera_begin"_a);
    module.def(
        "pair_noise", &pair_noise, "covariance"_a, "detection"_a, "order"_a, "factor"_a, "map_m2"_a, "by_place"_a);
    module.def("whiten", &whiten, "noise"_a, "residual"_a, "slope"_a);
    module.def("distances", &distances, "noise"_a, "residual"_a, "slope"_a);
}

}  // namespace v2hdm
