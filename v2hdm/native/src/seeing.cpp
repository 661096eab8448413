#include "seeing.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace v2hdm {
namespace {

constexpr int TERMS = 15;  // geometry.rigid.SERIES_TERMS
// Numbers of the vehicle's states that points depend on; belief.X to belief.LATE.
constexpr int X = 0, Y = 1, HEADING = 2, HEIGHT = 5, ROLL = 6, PITCH = 7, SLOW_ROLL = 8, SLOW_PITCH = 9;

// The sum over n of (-theta^2)^n / (2 n + offset)!.
double even_series(double squared, int offset) {
    double term = 1;
    for (int k = 2; k <= offset; ++k) term /= k;
    double total = 0;
    for (int n = 0; n < TERMS; ++n) {
        total += term;
        term *= -squared / ((2 * n + offset + 1) * (2 * n + offset + 2));
    }
    return total;
}

void cross(const double* a, const double* b, double* out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

void product(const double (&a)[3][3], const double (&b)[3][3], double (&out)[3][3]) {
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) out[i][j] = a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j];
    }
}

// The motion (rotation, shift) of a tangent; geometry.rigid.exp.
void exponential(const double* tangent, double (&rotation)[3][3], double (&shift)[3]) {
    const double *moved = tangent, *w = tangent + 3;
    const double omega[3][3] = {{0, -w[2], w[1]}, {w[2], 0, -w[0]}, {-w[1], w[0], 0}};
    double squared[3][3];
    product(omega, omega, squared);
    const double theta2 = dot(w, w);
    const double sine = even_series(theta2, 1), cosine = even_series(theta2, 2), third = even_series(theta2, 3);
    for (int i = 0; i < 3; ++i) {
        shift[i] = moved[i];
        for (int j = 0; j < 3; ++j) {
            rotation[i][j] = (i == j) + sine * omega[i][j] + cosine * squared[i][j];
            shift[i] += (cosine * omega[i][j] + third * squared[i][j]) * moved[j];
        }
    }
}

// Derivatives of a pixel by the states of the vehicle, of one coordinate.
void by_vehicle(const SeeingCamera& camera, const double* by_point, const double* vehicle, double* out) {
    const double* up = camera.rotation[2];
    const double flat = std::max(std::hypot(up[1], up[2]), 1e-9);
    // About the axis up in the map, the vehicle's axis ahead, and its axis to the left before it rolls.
    const double ahead[3] = {1, 0, 0}, left[3] = {0, up[2] / flat, -up[1] / flat};
    double turned[3];
    for (int axis = 0; axis < 2; ++axis) out[axis] = -dot(by_point, camera.rotation[axis]);
    out[HEIGHT] = -dot(by_point, up);
    cross(vehicle, up, turned);
    out[HEADING] = dot(by_point, turned);
    cross(vehicle, ahead, turned);
    out[ROLL] = out[SLOW_ROLL] = dot(by_point, turned);
    cross(vehicle, left, turned);
    out[PITCH] = out[SLOW_PITCH] = dot(by_point, turned);
}

}  // namespace

SeeingCamera::SeeingCamera(
    const double* map_from_vehicle, const double* cam_from_vehicle, const double* tangent, const double* matrix) {
    double calibrated[3][3], error[3][3], moved[3];
    for (int i = 0; i < 3; ++i) {
        place[i] = map_from_vehicle[4 * i + 3];
        for (int j = 0; j < 3; ++j) {
            rotation[i][j] = map_from_vehicle[4 * i + j];
            calibrated[i][j] = cam_from_vehicle[4 * i + j];
        }
    }
    exponential(tangent, error, moved);
    product(error, calibrated, turn);
    const double calibrated_shift[3] = {cam_from_vehicle[3], cam_from_vehicle[7], cam_from_vehicle[11]};
    for (int i = 0; i < 3; ++i) shift[i] = dot(error[i], calibrated_shift) + moved[i];
    for (int i = 0; i < 2; ++i) std::copy(matrix + 3 * i, matrix + 3 * i + 3, intrinsic[i]);
}

void expect_point(const SeeingCamera& camera, const double* point_map, double nearest_m, const SeenPoint& out) {
    const double offset[3] = {
        point_map[0] - camera.place[0], point_map[1] - camera.place[1], point_map[2] - camera.place[2]};
    double vehicle[3], cam[3];
    for (int i = 0; i < 3; ++i) {
        vehicle[i] = offset[0] * camera.rotation[0][i] + offset[1] * camera.rotation[1][i] + offset[2] * camera.rotation[2][i];
    }
    for (int i = 0; i < 3; ++i) cam[i] = dot(camera.turn[i], vehicle) + camera.shift[i];
    *out.depth_m = cam[2];
    const double safe = cam[2] > nearest_m ? cam[2] : std::numeric_limits<double>::quiet_NaN();
    for (int axis = 0; axis < 2; ++axis) {
        const double px = dot(camera.intrinsic[axis], cam) / safe;
        out.px[axis] = px;
        const double* k = camera.intrinsic[axis];
        const double by_cam[3] = {k[0] / safe, k[1] / safe, (k[2] - px) / safe};
        double by_point[3];
        for (int j = 0; j < 3; ++j) {
            by_point[j] = by_cam[0] * camera.turn[0][j] + by_cam[1] * camera.turn[1][j] + by_cam[2] * camera.turn[2][j];
        }
        double* by_states = out.by_states + axis * IMAGE_STATES;
        by_vehicle(camera, by_point, vehicle, by_states);
        std::copy(by_cam, by_cam + 3, by_states + VEHICLE_STATES);
        cross(cam, by_cam, by_states + VEHICLE_STATES + 3);
        for (int j = 0; j < 2; ++j) out.by_place[2 * axis + j] = dot(by_point, camera.rotation[j]);
    }
}

void spread_pair(const Roots& roots, const double* by_states, const double* by_place, int64_t state, double* out) {
    const auto add = [&](size_t row, double factor, double* to) {
        const double* from = roots.root + row * roots.width;
        for (size_t column = 0; column < roots.width; ++column) to[column] += factor * from[column];
    };
    std::fill(out, out + PAIR * roots.width, 0.0);
    for (int row = 0; row < PAIR; ++row) {
        double* to = out + row * roots.width;
        const double* by = by_states + row * IMAGE_STATES;
        for (int k = 0; k < VEHICLE_STATES; ++k) {
            if (by[k] != 0) add(k, by[k], to);
        }
        for (int k = 0; k < CAMERA_STATES; ++k) add(roots.camera_begin + k, by[VEHICLE_STATES + k], to);
        for (int axis = 0; state >= 0 && axis < 2; ++axis) add(state + axis, by_place[2 * row + axis], to);
    }
}

void noise_pair(
    const double* covariance, const int64_t* order, double factor, const double* map_m2, const double* by_place,
    double* out) {
    for (int row = 0; row < PAIR; ++row) {
        for (int column = 0; column < PAIR; ++column) {
            // Of the rows' corner and the columns' corner.
            const double *first = by_place + 2 * row, *second = by_place + 2 * column;
            const double* map = map_m2 + PAIR * 2 * (row / 2) + 2 * (column / 2);
            const double across = first[0] * (map[0] * second[0] + map[1] * second[1])
                + first[1] * (map[PAIR] * second[0] + map[PAIR + 1] * second[1]);
            out[PAIR * row + column] = factor * covariance[PAIR * order[row] + order[column]] + across;
        }
    }
}

bool factor_pair(double* matrix) {
    for (int i = 0; i < PAIR; ++i) {
        for (int j = 0; j <= i; ++j) {
            double rest = matrix[PAIR * i + j];
            for (int k = 0; k < j; ++k) rest -= matrix[PAIR * i + k] * matrix[PAIR * j + k];
            if (i != j) {
                matrix[PAIR * i + j] = rest * matrix[PAIR * j + j];
            } else if (rest > 0) {
                matrix[PAIR * i + i] = 1 / std::sqrt(rest);
            } else {
                return false;
            }
        }
    }
    return true;
}

void whiten_pair(const double* factor, double* x, size_t width) {
    for (int i = 0; i < PAIR; ++i) {
        double* to = x + i * width;
        for (int k = 0; k < i; ++k) {
            const double by = factor[PAIR * i + k];
            const double* from = x + k * width;
            for (size_t column = 0; column < width; ++column) to[column] -= by * from[column];
        }
        const double inverse = factor[PAIR * i + i];
        for (size_t column = 0; column < width; ++column) to[column] *= inverse;
    }
}

}  // namespace v2hdm
